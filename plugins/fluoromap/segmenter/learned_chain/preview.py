"""Electrodes around one frame, to show them before the geometry of the run is complete."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fluoromap.catheters import Catalogue
from fluoromap.contracts import FrameSource, Preview, Run, Segmenter, Silent
from fluoromap.segmenter.runs.hypotheses.scale_and_polarity import SCALES_PX_PER_MM, find_scale

_NEIGHBOURS = 2
"""Frames before and after the shown one: chains that they confirm are accepted."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """``count`` frames of a run from ``first`` on, as a frame source."""

    frames: FrameSource
    first: int
    count: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.frames.shape

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> NDArray[np.generic]:
        if not 0 <= index < self.count:
            raise IndexError(f"frame {index} of {len(self)}")
        return self.frames[self.first + index]

    def __iter__(self) -> Iterator[NDArray[np.generic]]:
        return (self[index] for index in range(self.count))


def preview(segmenter: Segmenter, run: Run, catalogue: Catalogue, frame: int, scale_is_known: bool) -> Preview:
    """Find the electrodes of one frame, for showing.

    The scale comes from the catalogue where the geometry gives none.

    Parameters
    ----------
    segmenter : Segmenter
        Of the frames around the shown one.
    run : Run
        Its ``px_per_mm`` counts only where ``scale_is_known``.
    catalogue : Catalogue
    frame : int
        From 0. The frames beside it confirm its chains.
    scale_is_known : bool
        Whether spacing and distances of the run are known.
    """
    scales = (run.px_per_mm,) if scale_is_known else SCALES_PX_PER_MM
    explained = find_scale(run, catalogue, scales)
    if explained is None and not scale_is_known:
        return Preview((), None, False, False)
    high_is_dark = run.pixels.monochrome1 if explained is None else explained.monochrome1
    px_per_mm = run.px_per_mm if explained is None else explained.px_per_mm
    first = max(0, frame - _NEIGHBOURS)
    last = min(len(run.frames), frame + _NEIGHBOURS + 1)
    around = replace(
        run,
        frames=_Stretch(run.frames, first, last - first),
        frame_times_ms=run.frame_times_ms[first:last] - run.frame_times_ms[first],
        px_per_mm=px_per_mm,
        pixels=replace(run.pixels, monochrome1=high_is_dark),
        r_wave_frames=(),
    )
    chains = segmenter.segment(around, catalogue, {}, Silent()).frames[frame - first].chains
    return Preview(chains, px_per_mm, not scale_is_known, high_is_dark != run.pixels.monochrome1)
