"""A catheter in the heart: its centre line at rest, and the same line bent by the moving tip without being stretched."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fluoromap.catheters import Catheter

Array = NDArray[np.float64]

_STEP_MM = 0.4
_BEND_MM = 25.0


@dataclass(frozen=True, eq=False)
class Shaft:
    """One catheter's centre line at rest.

    catheter : its electrodes. radius_mm : of shaft and rings. solid_tip : the tip electrode is nearly solid metal.
    rest_mm : (k, 3) points of the centre line, from the tip's end until well outside the field.
    """

    catheter: Catheter
    radius_mm: float
    solid_tip: bool
    rest_mm: Array

    @classmethod
    def through(
        cls, catheter: Catheter, radius_mm: float, solid_tip: bool, tip: Array, behind: Array, bow: Array, entry: Array
    ) -> Shaft:
        """Along the Bezier curve from ``tip``, leaving it towards ``behind``, bowed towards ``bow``, to ``entry``; (3,) mm."""
        t = np.linspace(0, 1, 1200)[:, None]
        curve = (1 - t) ** 3 * tip + 3 * (1 - t) ** 2 * t * behind + 3 * (1 - t) * t**2 * bow + t**3 * entry
        length = arc_lengths_mm(curve[None])[0]
        wanted = np.arange(0, length[-1], _STEP_MM)
        rest = np.stack([np.interp(wanted, length, curve[:, axis]) for axis in range(3)], axis=1)
        return cls(catheter, radius_mm, solid_tip, rest)

    def slipped(self, displacement_mm: Array) -> Shaft:
        """The same catheter with its tip at rest elsewhere, displaced by ``(3,)`` mm."""
        return replace(self, rest_mm=self.moved(displacement_mm[None])[0])

    def moved(self, displacements_mm: Array) -> Array:
        """Centre lines for tip displacements ``(t, 3)``, shape (t, k, 3).

        Far from the tip the shaft moves half as much. Arc length counts from the moved tip, so electrodes keep
        their distances and the shaft slides in its vessel.
        """
        depth = _STEP_MM * np.arange(len(self.rest_mm))
        share = 0.5 + 0.5 * np.exp(-depth / _BEND_MM)
        return np.asarray(self.rest_mm + share[:, None] * displacements_mm[:, None, :])

    def electrodes_mm(self, lines_mm: Array) -> Array:
        """Centres of the electrodes on centre lines ``(t, k, 3)``, tip first, shape (t, electrodes, 3)."""
        wanted = self.catheter.tip_mm / 2 + self.catheter.arc_lengths_mm
        length = arc_lengths_mm(lines_mm)
        centres = np.empty((len(lines_mm), len(wanted), 3))
        for row, (line, along) in enumerate(zip(lines_mm, length, strict=True)):
            for axis in range(3):
                centres[row, :, axis] = np.interp(wanted, along, line[:, axis])
        return centres

    @property
    def bands_mm(self) -> Array:
        """Arc lengths from the tip's end where each electrode begins and ends, shape (electrodes, 2)."""
        centres = self.catheter.tip_mm / 2 + self.catheter.arc_lengths_mm
        half = np.full(len(centres), self.catheter.ring_mm / 2)
        half[0] = self.catheter.tip_mm / 2
        return np.stack([centres - half, centres + half], axis=1)


def arc_lengths_mm(lines_mm: Array) -> Array:
    """Distance along centre lines ``(t, k, 3)`` from their first point, shape (t, k)."""
    steps = np.linalg.norm(np.diff(lines_mm, axis=1), axis=2)
    return np.concatenate([np.zeros((len(lines_mm), 1)), np.cumsum(steps, axis=1)], axis=1)
