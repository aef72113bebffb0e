"""Segmenter ``learned-chain``: a network proposes electrodes; they are linked to the chains that the catalogue allows."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel, Field

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Marks, Run, Segmentation
from fluoromap.segmenter.chain_fitting import names_with_long_tips
from fluoromap.segmenter.field_mask import FieldMask
from fluoromap.segmenter.learned_chain.absent_catheters import AbsentCatheters, absent_catheters, without_absent
from fluoromap.segmenter.learned_chain.added_catheters import add_catheters
from fluoromap.segmenter.learned_chain.detector import electrode_chains
from fluoromap.segmenter.learned_chain.explanation import frame_electrodes, is_inverted, promising_scales
from fluoromap.segmenter.learned_chain.frame_answers import StoredAnswers
from fluoromap.segmenter.learned_chain.other_scales import UsefulScales, useful_scales
from fluoromap.segmenter.learned_chain.track_evidence import TrackEvidence
from fluoromap.segmenter.learned_chain.unlisted_catheters import (
    ShowsUnlisted,
    asked_frames,
    frame_shows_more,
    listed_alone,
    run_shows_more,
    with_usual_types,
)
from fluoromap.segmenter.learned_chain.weights import SHIPPED, Trained, read_weights
from fluoromap.segmenter.run_segmentation import Detector, recall_for, segment_run
from fluoromap.segmenter.visible_part import visible_part
from fluoromap.segmenter.warm_up import prepare

_DIM_BELOW = 0.02
"""Probabilities fall fast: an electrode of a fiftieth of its chain's best probability was only predicted."""

T = TypeVar("T")

_log = logging.getLogger(__name__)


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


class LearnedChainParams(BaseModel, extra="forbid"):
    """Parameters of the learned segmenter."""

    weights: str | None = Field(
        None,
        max_length=1024,
        description="Path of a weights file of ``python -m fluoromap.training``; the shipped one by default.",
    )


class LearnedChain:
    """Electrodes that a small network and blobs propose, chains of them that fit the catalogue, the best set of chains.

    The network was trained on synthetic fluoroscopy with cables, wires, probes and contrast-filled vessels. Everything after it
    is shared with ``catheter-chain``.
    """

    name: ClassVar[str] = "learned-chain"
    version: ClassVar[str] = "46"
    Params: ClassVar[type[BaseModel]] = LearnedChainParams

    def __init__(self, params: LearnedChainParams | None = None) -> None:
        self.params = params or LearnedChainParams()

    @classmethod
    def warm_up(cls) -> None:
        """Compile the kernels, or load them from the cache."""
        prepare(cls())

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Segment a run; see :class:`~fluoromap.contracts.Segmenter`."""
        trained = read_weights(SHIPPED if self.params.weights is None else Path(self.params.weights))
        tried: dict[tuple[float, Catalogue], Segmentation] = {}

        def automatic(px_per_mm: float, sought: Catalogue = catalogue) -> Segmentation:
            if (px_per_mm, sought) not in tried:
                shown = replace(run, px_per_mm=px_per_mm)
                # Progress must not begin again.
                watched = _WithoutProgress(context) if tried else context
                tried[px_per_mm, sought] = self._segment(shown, sought, {}, watched, trained)
            return tried[px_per_mm, sought]

        def choose() -> UsefulScales:
            def promising(scales_px_per_mm: Sequence[float], least: float) -> Sequence[float]:
                return promising_scales(run, catalogue, scales_px_per_mm, least, trained)

            return useful_scales(run.px_per_mm, catalogue, automatic, promising)

        # Marks must not change the scales and what is sought, else they would change the automatic chains beside them.
        recall = recall_for(run, catalogue, context)
        first, *others = recall(UsefulScales, (), choose).px_per_mm
        shown = replace(run, px_per_mm=first)

        def in_all_scales(found: Segmentation) -> Segmentation:
            for scale in others:
                found = add_catheters(found, automatic(scale), catalogue, scale)
            return found

        def search_absent() -> AbsentCatheters:
            return absent_catheters(in_all_scales(automatic(first)), catalogue)

        absent = recall(AbsentCatheters, (), search_absent).names

        def completed(found: Segmentation) -> Segmentation:
            found = in_all_scales(found)
            if not absent:
                return found
            return add_catheters(found, automatic(first, without_absent(catalogue, absent)), catalogue, first)

        with_unlisted = with_usual_types(catalogue)

        def search_unlisted() -> ShowsUnlisted:
            found = completed(automatic(first))
            # A whole segmentation takes long: chance shows one more catheter in one frame, but rarely in two.
            in_frames = any(entry.chains for entry in found.frames) and all(
                frame_shows_more(frame_electrodes(shown, with_unlisted, frame, trained), found, frame)
                for frame in asked_frames(len(run.frames))
            )
            return ShowsUnlisted(in_frames and run_shows_more(automatic(first, with_unlisted), found))

        def segmented(sought: Catalogue) -> Segmentation:
            return self._segment(shown, sought, marks, context, trained) if marks else automatic(first, sought)

        if recall(ShowsUnlisted, (), search_unlisted).is_shown:
            return listed_alone(segmented(with_unlisted), catalogue)
        found = completed(segmented(catalogue))
        if not any(entry.chains for entry in found.frames) and is_inverted(run, catalogue, trained):
            inverted = replace(run.pixels, monochrome1=not run.pixels.monochrome1)
            of_inverted = self._segment(replace(run, pixels=inverted), catalogue, marks, context, trained)
            if any(entry.chains for entry in of_inverted.frames):
                _log.warning(
                    "The electrodes are bright: the grey levels were inverted although the header does not say so."
                )
                found = of_inverted
        return found

    def _segment(
        self, run: Run, catalogue: Catalogue, marks: Marks, context: Context, trained: Trained
    ) -> Segmentation:
        alone = len(run.frames) == 1
        frame_ms = float(np.diff(run.frame_times_ms).max(initial=0.0))

        answers = StoredAnswers()

        def detector_of(field: FieldMask) -> Detector:
            return electrode_chains(catalogue, field, run.pixels, run.px_per_mm, trained, alone, frame_ms, answers)

        judge = (
            None
            if alone
            else TrackEvidence(
                trained,
                run.px_per_mm,
                run.frame_times_ms,
                names_with_long_tips(catalogue),
                frozenset(catheter.name for catheter in catalogue.catheters if catheter.is_circular),
            )
        )
        found = segment_run(run, catalogue, marks, context, detector_of, True, True, judge, oblique=True)
        return visible_part(found, _DIM_BELOW)
