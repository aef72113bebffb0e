"""Chains of successive frames that are the same catheter get the same track number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.contracts import Array, Chain

_SPEED_PX_PER_MS = 13.0 / 16.7
_FARTHEST_PX = 45.0
_NEAREST_PX = 13.0
_BEND_PX = 8.0
_KEPT_VELOCITY = 0.6
_OTHER_KIND = 6.0
_IMPOSSIBLE = 1e6


@dataclass(slots=True)
class _Track:
    chain: Chain
    time_ms: float
    velocity: Array


def chain_distance(one: Chain, other: Chain, shift: Array | None = None) -> tuple[float, float]:
    """(mean shift, largest rest after that shift) in pixels over the electrodes both chains have; infinite without any."""
    common = sorted(set(one.electrodes) & set(other.electrodes))
    if not common:
        return np.inf, np.inf
    mine = one.pixels_uv[[one.electrodes.index(number) for number in common]]
    theirs = other.pixels_uv[[other.electrodes.index(number) for number in common]]
    difference = theirs - mine - (0.0 if shift is None else shift)
    mean = difference.mean(axis=0)
    return float(np.linalg.norm(mean)), float(np.linalg.norm(difference - mean, axis=1).max())


def kind_overlap(one: Chain, other: Chain) -> float:
    """0 where the two cannot be the same catheter, 1 where their probabilities agree as far as they can."""
    agreement = sum(probability * other.probability(name) for name, probability in one.kinds)
    squares = [sum(probability**2 for _, probability in chain.kinds) for chain in (one, other)]
    return agreement / max(*squares, 1e-9)


class Tracker:
    """Assigns the chains of each frame to tracks: predicted by 0.6 of the last velocity, gated, least total cost.

    Cost is the mean shift plus twice the largest change of shape, plus a price for unlike kinds. A track waits for ever: a
    catheter comes back to its place with the next beat. Keeps one chain a track.
    """

    def __init__(self) -> None:
        self._tracks: list[_Track] = []

    def follow(self, chains: Sequence[Chain], time_ms: float) -> tuple[Chain, ...]:
        """The chains of the next frame with their track numbers; new ones where nothing fits."""
        numbers = self._assign(chains, time_ms)
        numbered = []
        for chain, number in zip(chains, numbers, strict=True):
            if number < 0:
                number = len(self._tracks)
                self._tracks.append(_Track(chain, time_ms, np.zeros(2)))
            else:
                track = self._tracks[number]
                elapsed = max(time_ms - track.time_ms, 1e-6)
                common = [k for k in chain.electrodes if k in track.chain.electrodes]
                moved = np.mean(
                    [
                        chain.pixels_uv[chain.electrodes.index(k)]
                        - track.chain.pixels_uv[track.chain.electrodes.index(k)]
                        for k in common
                    ],
                    axis=0,
                )
                self._tracks[number] = _Track(chain, time_ms, _KEPT_VELOCITY * moved / elapsed)
            numbered.append(replace(chain, track=number))
        return tuple(numbered)

    def _assign(self, chains: Sequence[Chain], time_ms: float) -> list[int]:
        if not chains or not self._tracks:
            return [-1] * len(chains)
        cost = np.full((len(chains), len(self._tracks)), _IMPOSSIBLE)
        for column, track in enumerate(self._tracks):
            elapsed = time_ms - track.time_ms
            gate = min(max(_NEAREST_PX, _SPEED_PX_PER_MS * elapsed), _FARTHEST_PX)
            # An old velocity says nothing about where the heart is now.
            shift = track.velocity * elapsed if elapsed < 50.0 else np.zeros(2)
            for row, chain in enumerate(chains):
                away, bent = chain_distance(track.chain, chain, shift)
                overlap = kind_overlap(track.chain, chain)
                if away <= gate and bent <= _BEND_PX and overlap > 0:
                    cost[row, column] = away + 2.0 * bent + _OTHER_KIND * (1.0 - min(overlap, 1.0))
        numbers = [-1] * len(chains)
        for taken_row, taken_column in zip(*linear_sum_assignment(cost), strict=True):
            if cost[taken_row, taken_column] < _IMPOSSIBLE:
                numbers[int(taken_row)] = int(taken_column)
        return numbers
