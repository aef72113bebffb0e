"""Chains at diastole: those of the mean of the quiet frames, as the run's tracks and the user's marks say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.segmenter.frames.detector import Detector
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.shape.chain_comparison import chain_distance, kind_overlap, reverse
from fluoromap.segmenter.tracks.track_agreement import with_shape_of_track

_SAME_PLACE_MM = 2.5
_SAME_TRACK_PX = 12.0


def turned_as_tracks(
    x: Image,
    chains: tuple[Chain, ...],
    detector: Detector,
    averaged: tuple[int, ...],
    entries: Sequence[FrameChains],
) -> tuple[Chain, ...]:
    """Return the mean image's chains in the direction of their tracks.

    All frames of a track decide about its direction. A turned chain is fitted again, because a tip is longer than a ring.
    """
    tracked = [other for frame in averaged for other in entries[frame].chains]
    as_tracks = []
    for chain in chains:
        other_way = reverse(chain)
        as_it_is, turned = (
            min((sum(chain_distance(one, other)) for other in tracked), default=np.inf) for one in (chain, other_way)
        )
        if turned <= _SAME_TRACK_PX < as_it_is:
            beside = [other for other in chains if other is not chain]
            again = detector.find_again(x, other_way, np.zeros(2), _SAME_TRACK_PX / 2, beside)
            chain = other_way if again is None else replace(again, tip_odds=other_way.tip_odds)
        as_tracks.append(chain)
    return tuple(as_tracks)


def add_missing_catheters(
    x: Image,
    found: tuple[Chain, ...],
    detector: Detector,
    averaged: tuple[int, ...],
    entries: Sequence[FrameChains],
    catheters: int,
) -> tuple[Chain, ...]:
    """Add catheters that only single frames show to the mean image's chains."""
    middle = averaged[len(averaged) // 2]
    chains = list(found)
    on_tracks = {chain.track for chain in assign_tracks(chains, averaged, entries)}
    for frame in sorted(averaged, key=lambda frame: abs(frame - middle)):
        for known in entries[frame].chains:
            if known.track not in on_tracks and len(chains) < catheters and not known.manual:
                on_tracks.add(known.track)
                carried = detector.find_again(x, known, np.zeros(2), _SAME_TRACK_PX / 2, chains)
                chains += [] if carried is None else [carried.on_track(-1)]
    return tuple(chains)


def with_shapes_of_tracks(
    x: Image,
    chains: tuple[Chain, ...],
    detector: Detector,
    averaged: tuple[int, ...],
    entries: Sequence[FrameChains],
) -> tuple[Chain, ...]:
    """Return the mean image's chains in the shape of their tracks."""
    middle = averaged[len(averaged) // 2]
    agreed = []
    for chain in chains:
        track = {entry.frame: other for entry in entries for other in entry.chains if other.track == chain.track}
        beside = [other for other in chains if other is not chain]

        def search(shape: Chain, shift: Array, reach_px: float, beside: list[Chain] = beside) -> Chain | None:
            return detector.find_again(x, shape, shift, reach_px, beside, same_shape=True)

        agreed.append(with_shape_of_track(chain, middle, track, search))
    return tuple(agreed)


def _is_same_catheter(one: Chain, other: Chain, px_per_mm: float) -> bool:
    """Return whether two chains of one moment share a certain name or the place."""
    if any(probability > 0.99 and other.probability(name) > 0.99 for name, probability in one.kinds):
        return True
    return sum(chain_distance(one, other)) <= _SAME_PLACE_MM * px_per_mm


def _merge_marks(marked: Sequence[Chain], automatic: Sequence[Chain], px_per_mm: float) -> tuple[Chain, ...]:
    return (
        *marked,
        *(chain for chain in automatic if not any(_is_same_catheter(chain, mark, px_per_mm) for mark in marked)),
    )


def apply_marks(
    chains: tuple[Chain, ...],
    averaged: tuple[int, ...],
    entries: Sequence[FrameChains],
    automatic: dict[int, tuple[Chain, ...]],
    motion: Array,
    px_per_mm: float,
) -> tuple[tuple[Chain, ...], tuple[int, ...]]:
    if not automatic:
        return chains, averaged
    middle = averaged[len(averaged) // 2]
    within = [frame for frame in automatic if frame in averaged]
    if within:
        nearest = min(within, key=lambda frame: abs(frame - middle))
        return _merge_marks(entries[nearest].chains, chains, px_per_mm), averaged
    tracks = {chain.track for chain in assign_tracks(chains, averaged, entries)}
    lacking = [frame for frame in automatic if any(chain.track not in tracks for chain in entries[frame].chains)]
    if not lacking:
        return chains, averaged
    quietest = min(lacking, key=lambda frame: float(motion[frame]))
    return _merge_marks(entries[quietest].chains, automatic[quietest], px_per_mm), (quietest,)


def on_tracks(chains: Sequence[Chain], entries: Sequence[FrameChains]) -> tuple[Chain, ...]:
    """Return the chains that were set by hand or belong to a track."""
    tracks = {chain.track for entry in entries for chain in entry.chains}
    return tuple(chain for chain in chains if chain.manual or chain.track in tracks)


def assign_tracks(
    chains: Sequence[Chain], averaged: Sequence[int], entries: Sequence[FrameChains]
) -> tuple[Chain, ...]:
    """Give each diastolic chain the track number of the averaged frames.

    The number is that of the chains at the same place, where most of the averaged frames that show the track show it there. Chains
    that cannot be the same catheter do not count, unless a user set one of them.
    """
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
                    if other.track not in taken and (chain.manual or other.manual or kind_overlap(chain, other) > 0)
                ]
                if near and min(near)[0] <= _SAME_TRACK_PX:
                    votes[min(near)[1]] = votes.get(min(near)[1], 0) + 1
            number = max(votes, key=lambda track: votes[track], default=-1)
            shown = sum(any(other.track == number for other in entries[frame].chains) for frame in averaged)
            if number < 0 or 2 * votes[number] < shown:
                number, fresh = fresh, fresh + 1
            taken.add(number)
            chain = chain.on_track(number)
        numbered.append(chain)
    return tuple(numbered)
