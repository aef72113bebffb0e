"""Segmenter ``four-step``: the paper's filter in every frame, linked to chains, and once more in the diastolic mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Chain, Context, FrameChains, Marks, Run, Segmentation
from fluoromap.reasons import Reason
from fluoromap.segmenter.field_mask import evenly_spaced, find_field
from fluoromap.segmenter.frame_chains import Detector, FourStepParams
from fluoromap.segmenter.log_image import LogTransform
from fluoromap.segmenter.quiet_frames import MotionMeter, diastolic_frames
from fluoromap.segmenter.tracking import Tracker, chain_distance

_SAME_PLACE_MM = 2.5


class FourStep:
    """The paper's segmentation: equations (4) to (7), disk morphology, Otsu, components; then linking by the catalogue.

    Every frame is filtered and linked on its own, and so is the mean of the quiet frames round diastole, in which the
    steeply angulated, noisy views succeed too that fail frame by frame.

    Marks stand in for what was found in their frames. At diastole they count like this: a mark in one of the averaged frames
    replaces the automatic chain of the same catheter or place; a mark elsewhere, of a catheter that diastole lacks, makes the
    quietest marked frame stand for diastole, with what was found automatically beside it in that frame.
    """

    name: ClassVar[str] = "four-step"
    version: ClassVar[str] = "1"
    Params: ClassVar[type[BaseModel]] = FourStepParams

    def __init__(self, params: FourStepParams | None = None) -> None:
        self.params = params or FourStepParams()

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation:
        """Chains of all frames and of the diastolic mean; see :class:`~fluoromap.contracts.Segmenter`."""
        context.check()
        field = find_field(run.frames, run.pixels)
        transform = LogTransform.of_run(run.pixels, field.mean_level)
        detector = Detector(catalogue, field, run.px_per_mm, self.params)
        count = len(run.frames)
        samples = (field.fill(transform(run.frames[index])) for index in evenly_spaced(count))
        meter, tracker = MotionMeter(samples, field.inside), Tracker()
        motion = np.zeros(count)
        entries: list[FrameChains] = []
        automatic: dict[int, tuple[Chain, ...]] = {}
        for index in range(count):
            context.check()
            x = field.fill(transform(run.frames[index]))
            motion[index] = meter(x)
            found = detector.chains(x, index)
            if index in marks:
                automatic[index] = found.chains
                found = FrameChains(index, tuple(replace(chain, manual=True) for chain in marks[index]))
            chains = tracker.follow(found.chains, float(run.frame_times_ms[index]))
            entries.append(FrameChains(index, chains, found.manual_needed))
            context.progress(0.95 * (index + 1) / count)
        if count > 1:
            motion[0] = motion[1]
        averaged = diastolic_frames(motion, run.frame_times_ms, run.r_wave_frames)
        context.check()
        total = np.zeros(run.frames.shape, np.float64)
        for index in averaged:
            total += run.frames[index].astype(np.float64)
        middle = averaged[len(averaged) // 2]
        mean = detector.chains(field.fill(transform(total / len(averaged))), middle)
        chains, averaged = _with_marks(mean.chains, averaged, entries, automatic, motion, run.px_per_mm)
        middle = averaged[len(averaged) // 2]
        chains = _on_tracks(chains, averaged, entries)
        diastole = FrameChains(middle, chains, None if chains else mean.manual_needed or Reason.MANUAL_NEEDED)
        context.progress(1.0)
        return Segmentation(
            frames=tuple(entries),
            diastole=diastole,
            diastole_frames=averaged,
            motion=motion,
            frame_times_ms=run.frame_times_ms,
            r_wave_frames=run.r_wave_frames,
        )


def _same(one: Chain, other: Chain, px_per_mm: float) -> bool:
    """Whether two chains of one moment are the same catheter: the same certain name, or the same place."""
    if any(probability > 0.99 and other.probability(name) > 0.99 for name, probability in one.kinds):
        return True
    return sum(chain_distance(one, other)) <= _SAME_PLACE_MM * px_per_mm


def _beside(marked: Sequence[Chain], automatic: Sequence[Chain], px_per_mm: float) -> tuple[Chain, ...]:
    return (
        *marked,
        *(chain for chain in automatic if not any(_same(chain, mark, px_per_mm) for mark in marked)),
    )


def _with_marks(
    chains: tuple[Chain, ...],
    averaged: tuple[int, ...],
    entries: Sequence[FrameChains],
    automatic: dict[int, tuple[Chain, ...]],
    motion: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    px_per_mm: float,
) -> tuple[tuple[Chain, ...], tuple[int, ...]]:
    if not automatic:
        return chains, averaged
    middle = averaged[len(averaged) // 2]
    within = [frame for frame in automatic if frame in averaged]
    if within:
        nearest = min(within, key=lambda frame: abs(frame - middle))
        return _beside(entries[nearest].chains, chains, px_per_mm), averaged
    tracks = {chain.track for chain in _on_tracks(chains, averaged, entries)}
    lacking = [frame for frame in automatic if any(chain.track not in tracks for chain in entries[frame].chains)]
    if not lacking:
        return chains, averaged
    quietest = min(lacking, key=lambda frame: float(motion[frame]))
    return _beside(entries[quietest].chains, automatic[quietest], px_per_mm), (quietest,)


def _on_tracks(chains: Sequence[Chain], averaged: Sequence[int], entries: Sequence[FrameChains]) -> tuple[Chain, ...]:
    """Give the diastolic chains the track numbers of the chains that lie in their place in the averaged frames."""
    taken: set[int] = {chain.track for chain in chains if chain.track >= 0}
    fresh = 1 + max((chain.track for entry in entries for chain in entry.chains), default=-1)
    numbered: list[Chain] = []
    for chain in chains:
        if chain.track < 0:
            votes: dict[int, int] = {}
            for frame in averaged:
                near = [
                    (sum(chain_distance(chain, other)), other.track)
                    for other in entries[frame].chains
                    if other.track not in taken
                ]
                if near and min(near)[0] <= 12.0:
                    votes[min(near)[1]] = votes.get(min(near)[1], 0) + 1
            if votes:
                number = max(votes, key=lambda track: votes[track])
            else:
                number, fresh = fresh, fresh + 1
            taken.add(number)
            chain = replace(chain, track=number)
        numbered.append(chain)
    return tuple(numbered)
