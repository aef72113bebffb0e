"""The left ventricle at diastole: an ellipsoid with a focus, and activation along its wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_LEVELS = 6
_SWEEPS = 60


@dataclass(frozen=True, eq=False)
class Chamber:
    """Endocardial wall of the ventricle at diastole, between breaths.

    Coordinates are millimetres along LPS axes from the isocentre.

    Parameters
    ----------
    centre_mm : ndarray, shape (3,)
    axes : ndarray, shape (3, 3)
        Rows are unit vectors: two across the ventricle (the first towards the right ventricle), the third from base to apex.
    semi_axes_mm : ndarray, shape (3,)
        Lengths along the rows of ``axes``.
    focus_mm : ndarray, shape (3,)
        Start of activation, on the wall.
    conduction_mm_per_ms : float
        Speed along the wall, the same everywhere; 1 mm/ms is 1 m/s.
    reference_ms : float
        Activation of the reference catheter after the focus: the zero of activation times. 0 without that catheter.
    """

    centre_mm: Array
    axes: Array
    semi_axes_mm: Array
    focus_mm: Array
    conduction_mm_per_ms: float
    reference_ms: float

    @property
    def volume_ml(self) -> float:
        """Volume of the ellipsoid, ml."""
        return float(4 / 3 * np.pi * np.prod(self.semi_axes_mm) / 1000)

    def level(self, points_mm: ArrayLike) -> Array:
        """Return the level (...) of points ``(..., 3)``: 1 on the wall, less inside."""
        unit = self._to_sphere(points_mm)
        return np.asarray(np.linalg.norm(unit, axis=-1))

    def on_wall(self, points_mm: ArrayLike) -> Array:
        """Move points ``(..., 3)`` along the line through the chamber's centre onto the wall."""
        unit = self._to_sphere(points_mm)
        return self._from_sphere(unit / np.linalg.norm(unit, axis=-1, keepdims=True))

    def inward(self, points_mm: ArrayLike) -> Array:
        """Return the wall's unit normals at points ``(..., 3)`` on it, into the blood."""
        normal = -(self._to_sphere(points_mm) / self.semi_axes_mm) @ self.axes
        unit: Array = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        return unit

    def wall_distance_mm(self, points_mm: ArrayLike) -> Array:
        """Return the length (...) of the shortest way along the wall from the focus to wall points ``(..., 3)``.

        The way starts as the arc of a great circle and is pulled tight: every point moves to the middle of its
        neighbours and back to the wall, on finer and finer polylines.
        """
        ends = self._to_sphere(points_mm)
        ends = ends / np.linalg.norm(ends, axis=-1, keepdims=True)
        start = np.broadcast_to(self._to_sphere(self.focus_mm), ends.shape)
        way = np.stack([start, ends])
        for _ in range(_LEVELS):
            finer = np.empty((2 * len(way) - 1, *way.shape[1:]))
            # The middle to a point exactly opposite the focus is undefined; the small number chooses a direction.
            finer[::2], finer[1::2] = way, _unit(way[1:] + way[:-1] + 1e-9)
            way = finer
            for _ in range(_SWEEPS):
                for first in (1, 2):
                    way[first:-1:2] = self._pull_tight(way[first - 1 : -2 : 2], way[first:-1:2], way[first + 1 :: 2])
        steps = np.diff(way * self.semi_axes_mm, axis=0)
        length: Array = np.linalg.norm(steps, axis=-1).sum(axis=0)
        return length

    def activation_ms(self, points_mm: ArrayLike) -> Array:
        """Return the activation times of wall points ``(..., 3)`` relative to the reference catheter.

        They have no noise and may be negative.
        """
        times: Array = self.wall_distance_mm(points_mm) / self.conduction_mm_per_ms - self.reference_ms
        return times

    def _pull_tight(self, before: Array, points: Array, after: Array) -> Array:
        """Move points along the wall to the middle of their neighbours.

        Points are those of the unit sphere that is the image of the wall.
        """
        pull = ((before + after) / 2 - points) * self.semi_axes_mm
        normal = _unit(points / self.semi_axes_mm)
        pull -= (pull * normal).sum(axis=-1, keepdims=True) * normal
        return _unit(points + pull / self.semi_axes_mm)

    def _to_sphere(self, points_mm: ArrayLike) -> Array:
        points = np.asarray(points_mm, dtype=np.float64)
        local: Array = ((points - self.centre_mm) @ self.axes.T) / self.semi_axes_mm
        return local

    def _from_sphere(self, unit: Array) -> Array:
        points: Array = (unit * self.semi_axes_mm) @ self.axes + self.centre_mm
        return points


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


def spread_over_wall(chamber: Chamber, count: int, rng: np.random.Generator) -> Array:
    """Return wall points (count, 3) far from each other, in random order.

    Apex and basal ring are included. The valve plane leaves the basal quarter of the ellipsoid without wall. Each next
    point is, of 1500 random candidates, the farthest from the points chosen so far.
    """
    candidates = chamber._from_sphere(_unit(rng.normal(size=(6000, 3))))
    height = (candidates - chamber.centre_mm) @ chamber.axes[2] / chamber.semi_axes_mm[2]
    candidates = candidates[(height > -0.5) & (height < 0.95)][:1500]
    chosen = [int(rng.integers(len(candidates)))]
    nearest = np.linalg.norm(candidates - candidates[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(candidates - candidates[chosen[-1]], axis=1))
    return np.asarray(candidates[rng.permutation(chosen)])
