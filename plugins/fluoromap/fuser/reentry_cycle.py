"""The cycle of a re-entry: times repeat, early meets late."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, BoolArray


@dataclass(frozen=True, slots=True)
class Cycle:
    """length_ms : of one cycle. start_ms : where the window of interest begins; it ends one cycle later."""

    length_ms: float
    start_ms: float

    @property
    def per_ms(self) -> float:
        """Radians of phase a millisecond."""
        return float(2 * np.pi / self.length_ms)

    def outside(self, times_ms: Array) -> BoolArray:
        """Which times (...) lie outside the window."""
        after: BoolArray = (times_ms < self.start_ms) | (times_ms >= self.start_ms + self.length_ms)
        return after

    def bring_in(self, times_ms: Array) -> Array:
        """Times (...) moved by whole cycles into the window; those within stay exactly as they are."""
        moved = self.start_ms + np.mod(times_ms - self.start_ms, self.length_ms)
        # A time a rounding error before the window would come out at its open end.
        moved = np.where(moved >= self.start_ms + self.length_ms, self.start_ms, moved)
        return np.where(self.outside(times_ms), moved, times_ms)

    def difference(self, late_ms: Array, early_ms: Array) -> Array:
        """``late - early`` by the shorter way round, within half a cycle."""
        return around(late_ms - early_ms, self.length_ms)

    def phase(self, times_ms: Array) -> Array:
        """Phase (...) in radians, 0 in the middle of the window."""
        phase: Array = (times_ms - self.start_ms - self.length_ms / 2) * self.per_ms
        return phase

    def times(self, mean: Array, variance: Array) -> tuple[Array, Array]:
        """Times and standard deviations (n,), (n,) in ms of phases with cosine and sine ``mean``, ``variance`` (n, 2).

        To first order the error across the direction of the phase over the length of the vector; never more than that of
        a time of which nothing is known but the cycle.
        """
        square = np.maximum((mean**2).sum(axis=1), 1e-12)
        across = (mean[:, 1] ** 2 * variance[:, 0] + mean[:, 0] ** 2 * variance[:, 1]) / square
        sd = np.minimum(np.sqrt(across / square) / self.per_ms, self.length_ms / np.sqrt(12.0))
        middle = self.start_ms + self.length_ms / 2
        return self.bring_in(middle + np.arctan2(mean[:, 1], mean[:, 0]) / self.per_ms), sd


def around(difference_ms: Array, cycle_length_ms: float) -> Array:
    """Differences (...) brought by whole cycles to between minus half a cycle, included, and half a cycle."""
    half = cycle_length_ms / 2
    near: Array = np.mod(difference_ms + half, cycle_length_ms) - half
    return near
