"""The cycle of a re-entry: times repeat after it, and early meets late."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, BoolArray


@dataclass(frozen=True, slots=True)
class Cycle:
    """A cycle of ``length_ms`` and its window of interest, from ``start_ms`` to one cycle later."""

    length_ms: float
    start_ms: float

    @property
    def per_ms(self) -> float:
        """Radians of phase per millisecond."""
        return float(2 * np.pi / self.length_ms)

    def outside(self, times_ms: Array) -> BoolArray:
        """Return True for times (...) outside the window."""
        outside: BoolArray = (times_ms < self.start_ms) | (times_ms >= self.start_ms + self.length_ms)
        return outside

    def into_window(self, times_ms: Array) -> Array:
        """Move times (...) into the window by whole cycles; times inside stay exactly unchanged."""
        moved = self.start_ms + np.mod(times_ms - self.start_ms, self.length_ms)
        # A time that precedes the window by a rounding error would otherwise get its open end.
        moved = np.where(moved >= self.start_ms + self.length_ms, self.start_ms, moved)
        return np.where(self.outside(times_ms), moved, times_ms)

    def difference(self, late_ms: Array, early_ms: Array) -> Array:
        """Return ``late - early`` by the shorter way around the cycle, within half a cycle."""
        return around(late_ms - early_ms, self.length_ms)

    def phase(self, times_ms: Array) -> Array:
        """Return the phase (...) in radians, 0 in the middle of the window."""
        phase: Array = (times_ms - self.start_ms - self.length_ms / 2) * self.per_ms
        return phase

    def times(self, mean: Array, variance: Array) -> tuple[Array, Array]:
        """Return times and standard deviations (n,), (n,) in ms.

        They follow from cosine and sine of phases. ``mean`` and ``variance`` (n, 2) are those of cosine and sine. To
        first order the phase's error is the vector's error across its direction, over its length. It is at most that of
        a uniform distribution over the cycle.
        """
        square = np.maximum((mean**2).sum(axis=1), 1e-12)
        across = (mean[:, 1] ** 2 * variance[:, 0] + mean[:, 0] ** 2 * variance[:, 1]) / square
        sd = np.minimum(np.sqrt(across / square) / self.per_ms, self.length_ms / np.sqrt(12.0))
        middle = self.start_ms + self.length_ms / 2
        return self.into_window(middle + np.arctan2(mean[:, 1], mean[:, 0]) / self.per_ms), sd


def around(difference_ms: Array, cycle_length_ms: float) -> Array:
    """Move differences (...) by whole cycles to within half a cycle.

    Minus half a cycle is included.
    """
    half = cycle_length_ms / 2
    near: Array = np.mod(difference_ms + half, cycle_length_ms) - half
    return near
