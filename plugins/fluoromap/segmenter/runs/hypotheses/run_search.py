"""All searches of one run: at several scales, without long catheters that do not show, with catheters that are not listed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Marks, Run, Segmentation
from fluoromap.segmenter.electrodes.network.weights import Trained
from fluoromap.segmenter.recall import recall_for
from fluoromap.segmenter.runs.hypotheses.absent_catheters import AbsentCatheters, absent_catheters, without_absent
from fluoromap.segmenter.runs.hypotheses.added_catheters import add_catheters
from fluoromap.segmenter.runs.hypotheses.other_scales import UsefulScales, useful_scales
from fluoromap.segmenter.runs.hypotheses.scale_and_polarity import frame_electrodes, promising_scales
from fluoromap.segmenter.runs.hypotheses.scale_search import search_at_scale
from fluoromap.segmenter.runs.hypotheses.unlisted_catheters import (
    ShowsUnlisted,
    asked_frames,
    frame_shows_more,
    listed_alone,
    run_shows_more,
    with_usual_types,
)

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class _WithoutProgress:
    """A context of work that is repeated: it may be stopped, and reports no progress."""

    context: Context

    def progress(self, fraction: float) -> None:
        """Report nothing."""

    def check(self) -> None:
        self.context.check()

    def recall(self, kind: type[T], inputs: tuple[object, ...], compute: Callable[[], T]) -> T:
        return self.context.recall(kind, inputs, compute)


class RunSearch:
    """The searches of one run, each made at most once.

    Searches without marks decide at which scales and for what the run is searched: marks must not change the automatic chains
    beside them.
    """

    def __init__(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context, trained: Trained) -> None:
        self._run = run
        self._catalogue = catalogue
        self._with_unlisted = with_usual_types(catalogue)
        self._marks = marks
        self._context = context
        self._trained = trained
        self._recall = recall_for(run, catalogue, context)
        self._made: dict[tuple[float, Catalogue], Segmentation] = {}

    def listed_catheters(self) -> Segmentation:
        """Return the chains of the study's catheters."""
        if self._recall(ShowsUnlisted, (), self._search_unlisted).is_shown:
            return listed_alone(self._marked(self._with_unlisted), self._catalogue)
        return self._completed(self._marked(self._catalogue))

    def inverted(self) -> Segmentation:
        """Return what one search finds with inverted grey levels."""
        pixels = replace(self._run.pixels, monochrome1=not self._run.pixels.monochrome1)
        run = replace(self._run, pixels=pixels)
        return search_at_scale(run, self._catalogue, self._marks, self._context, self._trained)

    @cached_property
    def _scales(self) -> tuple[float, ...]:
        useful: UsefulScales = self._recall(UsefulScales, (), self._search_scales)
        return useful.px_per_mm

    @cached_property
    def _absent(self) -> tuple[str, ...]:
        absent: AbsentCatheters = self._recall(AbsentCatheters, (), self._search_absent)
        return absent.names

    def _search_scales(self) -> UsefulScales:
        def automatic(px_per_mm: float) -> Segmentation:
            return self._automatic(px_per_mm, self._catalogue)

        def promising(scales_px_per_mm: Sequence[float], least: float) -> Sequence[float]:
            return promising_scales(self._run, self._catalogue, scales_px_per_mm, least, self._trained)

        return useful_scales(self._run.px_per_mm, self._catalogue, automatic, promising)

    def _search_absent(self) -> AbsentCatheters:
        found = self._automatic(self._scales[0], self._catalogue)
        return absent_catheters(self._in_all_scales(found), self._catalogue)

    def _search_unlisted(self) -> ShowsUnlisted:
        first = self._scales[0]
        found = self._completed(self._automatic(first, self._catalogue))

        def shows_more(frame: int) -> bool:
            shown = replace(self._run, px_per_mm=first)
            return frame_shows_more(frame_electrodes(shown, self._with_unlisted, frame, self._trained), found, frame)

        # A whole segmentation takes long: chance shows one more catheter in one frame, but rarely in two.
        in_frames = any(entry.chains for entry in found.frames) and all(
            map(shows_more, asked_frames(len(self._run.frames)))
        )
        if not in_frames:
            return ShowsUnlisted(False)
        return ShowsUnlisted(run_shows_more(self._automatic(first, self._with_unlisted), found, self._catalogue))

    def _completed(self, found: Segmentation) -> Segmentation:
        """Add what the other scales show, and what shows without the absent catheters."""
        found = self._in_all_scales(found)
        if not self._absent:
            return found
        first = self._scales[0]
        others = self._automatic(first, without_absent(self._catalogue, self._absent))
        return add_catheters(found, others, self._catalogue, first)

    def _in_all_scales(self, found: Segmentation) -> Segmentation:
        for scale in self._scales[1:]:
            found = add_catheters(found, self._automatic(scale, self._catalogue), self._catalogue, scale)
        return found

    def _marked(self, sought: Catalogue) -> Segmentation:
        """Return what the search at the first scale finds with the marks."""
        first = self._scales[0]
        if not self._marks:
            return self._automatic(first, sought)
        run = replace(self._run, px_per_mm=first)
        return search_at_scale(run, sought, self._marks, self._context, self._trained)

    def _automatic(self, px_per_mm: float, sought: Catalogue) -> Segmentation:
        if (px_per_mm, sought) not in self._made:
            run = replace(self._run, px_per_mm=px_per_mm)
            # Progress must not begin again.
            context = _WithoutProgress(self._context) if self._made else self._context
            self._made[px_per_mm, sought] = search_at_scale(run, sought, {}, context, self._trained)
        return self._made[px_per_mm, sought]
