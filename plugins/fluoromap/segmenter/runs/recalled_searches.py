"""Searches of a run whose answers are partial results: in a frame, in moved means, along a track."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Chain, Context, Run
from fluoromap.segmenter.frames.detector import Detector
from fluoromap.segmenter.judge.verdict import TrackJudge, Verdict
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.picture.moved_means import WINDOW_MS
from fluoromap.segmenter.places.oblique_places import place_obliquely
from fluoromap.segmenter.recall import Recall
from fluoromap.segmenter.runs.partial_results import (
    FoundAgain,
    FoundMoving,
    ObliquePlaces,
)
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES
from fluoromap.segmenter.tracks.hidden_catheters import MovingSearch
from fluoromap.segmenter.tracks.track import ChainSearch

_LEAST_MOVED = 5
_SURE_ROW = 1.0
"""Log-odds of the middle electrode of a long row that is not judged again."""
RunJudge = Callable[[Mapping[int, Chain], Callable[[int], Image], Recall[Any]], Verdict]
"""(frame -> chain of one track, frame -> log image, recall) -> whether the run shows a catheter there."""
PlaceObliquely = Callable[[int, tuple[Chain, ...]], tuple[Chain, ...]]
"""(frame, its chains) -> the chains at the places of :func:`~fluoromap.segmenter.places.oblique_places.place_obliquely`."""


def oblique_placing(
    run: Run, catalogue: Catalogue, log_image: Callable[[int], Image], recall: Recall[ObliquePlaces]
) -> PlaceObliquely:
    def place(frame: int, chains: tuple[Chain, ...]) -> tuple[Chain, ...]:
        def compute() -> ObliquePlaces:
            return ObliquePlaces(place_obliquely(log_image(frame), chains, catalogue, run.px_per_mm))

        return recall(ObliquePlaces, (frame, *chains), compute).chains if chains else ()

    return place


def track_judge(
    shows_catheter: RunJudge, log_image: Callable[[int], Image], recall: Recall[Any], place: PlaceObliquely | None
) -> TrackJudge:
    """Return the judge of a run's tracks.

    Openings hide the middles of a long row's rings, so that it is judged again at its final places where it is not clear.
    """

    def judge(chains: Mapping[int, Chain]) -> Verdict:
        verdict = shows_catheter(chains, log_image, recall)
        is_row = max(len(chain.electrodes) for chain in chains.values()) >= MANY_ELECTRODES
        if place is None or not is_row or (verdict.is_catheter and verdict.log_odds >= _SURE_ROW):
            return verdict
        placed = {frame: place(frame, (chain,))[0] for frame, chain in chains.items()}
        again = shows_catheter(placed, log_image, recall)
        return max(verdict, again, key=lambda one: (one.is_catheter, one.log_odds))

    return judge


def chain_search(
    detector: Detector, log_image: Callable[[int], Image], context: Context, recall: Recall[FoundAgain]
) -> ChainSearch:
    kept: tuple[int, Image] | None = None

    def search(
        frame: int,
        chain: Chain,
        shift: Array,
        reach_px: float,
        taken: Sequence[Chain],
        same_shape: bool = False,
        confirmed: bool = False,
    ) -> Chain | None:
        def find() -> FoundAgain:
            nonlocal kept
            if kept is None or kept[0] != frame:
                context.check()
                kept = frame, log_image(frame)
            return FoundAgain(detector.find_again(kept[1], chain, shift, reach_px, taken, frame, same_shape, confirmed))

        # A frame may be a number of NumPy, and ``taken`` may grow later.
        return recall(
            FoundAgain, (int(frame), chain, shift, reach_px, same_shape, confirmed, len(taken), *taken), find
        ).chain

    return search


def moving_search(
    detector: Detector,
    log_image: Callable[[int], Image],
    frame_times_ms: Array,
    context: Context,
    recall: Recall[FoundMoving],
) -> MovingSearch:
    """Return the search for moving catheters round a frame.

    It finds none where few frames are near in time.
    """

    def search(frame: int) -> tuple[Chain, ...]:
        context.check()
        near = np.flatnonzero(np.abs(frame_times_ms - frame_times_ms[frame]) <= WINDOW_MS)
        if len(near) < _LEAST_MOVED:
            return ()

        def find() -> FoundMoving:
            images = [log_image(int(index)) for index in near]
            return FoundMoving(detector.find_moving(images, frame_times_ms[near], frame - int(near[0]), frame))

        return recall(FoundMoving, (frame,), find).chains

    return search
