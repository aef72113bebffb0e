"""A catheter's shaft: its centre line at rest and bent by the moving tip."""

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

    catheter : its electrodes. radius_mm : of shaft and rings. solid_tip : True for a tip electrode of nearly solid metal.
    rest_mm : (k, 3) points of the centre line, from the tip's end to well outside the field.
    """

    catheter: Catheter
    radius_mm: float
    solid_tip: bool
    rest_mm: Array

    @classmethod
    def through(
        cls, catheter: Catheter, radius_mm: float, solid_tip: bool, tip: Array, behind: Array, bow: Array, entry: Array
    ) -> Shaft:
        """Make a shaft along a Bezier curve.

        The curve starts at ``tip`` towards ``behind``, bends towards ``bow`` and ends at ``entry``; each (3,) mm.
        """
        t = np.linspace(0, 1, 1200)[:, None]
        curve = (1 - t) ** 3 * tip + 3 * (1 - t) ** 2 * t * behind + 3 * (1 - t) * t**2 * bow + t**3 * entry
        length = arc_lengths_mm(curve[None])[0]
        wanted = np.arange(0, length[-1], _STEP_MM)
        rest = np.stack([np.interp(wanted, length, curve[:, axis]) for axis in range(3)], axis=1)
        return cls(catheter, radius_mm, solid_tip, rest)

    @classmethod
    def around(cls, catheter: Catheter, radius_mm: float, centre: Array, normal: Array, entry: Array) -> Shaft:
        """Make a shaft whose electrodes lie on a loop about ``centre``.

        The loop lies across ``normal`` and has the catheter's curvature; then the shaft bends to ``entry``. Each is (3,), mm.
        """
        normal = normal / np.linalg.norm(normal)
        side = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
        side /= np.linalg.norm(side)
        other = np.cross(normal, side)
        round_mm = float(catheter.arc_lengths_mm[-1]) + 0.5 * catheter.tip_mm + catheter.ring_mm
        loop_radius = 1.0 / catheter.curvature_per_mm
        angles = np.linspace(0.0, round_mm * catheter.curvature_per_mm, 400)[:, None]
        loop = centre + loop_radius * (np.cos(angles) * side + np.sin(angles) * other)
        leaving = np.cos(angles[-1]) * other - np.sin(angles[-1]) * side
        back = normal if normal @ (entry - centre) > 0 else -normal
        t = np.linspace(0, 1, 800)[1:, None]
        start, behind, bow = loop[-1], loop[-1] + 15.0 * leaving, loop[-1] + 30.0 * back
        shaft = (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * behind + 3 * (1 - t) * t**2 * bow + t**3 * entry
        curve = np.concatenate([loop, shaft])
        length = arc_lengths_mm(curve[None])[0]
        wanted = np.arange(0, length[-1], _STEP_MM)
        rest = np.stack([np.interp(wanted, length, curve[:, axis]) for axis in range(3)], axis=1)
        return cls(catheter, radius_mm, False, rest)

    def with_tip_displaced(self, displacement_mm: Array) -> Shaft:
        """Return the catheter with the resting place of its tip displaced by ``(3,)`` mm."""
        return replace(self, rest_mm=self.lines_mm(displacement_mm[None])[0])

    def lines_mm(self, displacements_mm: Array) -> Array:
        """Return the centre lines (t, k, 3) for tip displacements ``(t, 3)``.

        Far from the tip the shaft moves half as much. Arc length is counted from the displaced tip, so that electrodes
        keep their distances and the shaft slides in its vessel.
        """
        depth = _STEP_MM * np.arange(len(self.rest_mm))
        share = 0.5 + 0.5 * np.exp(-depth / _BEND_MM)
        return np.asarray(self.rest_mm + share[:, None] * displacements_mm[:, None, :])

    def electrodes_mm(self, lines_mm: Array) -> Array:
        """Return the centres (t, electrodes, 3) of the electrodes on centre lines ``(t, k, 3)``, tip first."""
        wanted = self.catheter.tip_mm / 2 + self.catheter.arc_lengths_mm
        length = arc_lengths_mm(lines_mm)
        centres = np.empty((len(lines_mm), len(wanted), 3))
        for row, (line, along) in enumerate(zip(lines_mm, length, strict=True)):
            for axis in range(3):
                centres[row, :, axis] = np.interp(wanted, along, line[:, axis])
        return centres

    @property
    def bands_mm(self) -> Array:
        """Arc lengths (electrodes, 2) from the tip's end to the start and end of each electrode, mm."""
        centres = self.catheter.tip_mm / 2 + self.catheter.arc_lengths_mm
        half = np.full(len(centres), self.catheter.ring_mm / 2)
        half[0] = self.catheter.tip_mm / 2
        return np.stack([centres - half, centres + half], axis=1)


def arc_lengths_mm(lines_mm: Array) -> Array:
    """Return the distance (t, k) along centre lines ``(t, k, 3)`` from their first point."""
    steps = np.linalg.norm(np.diff(lines_mm, axis=1), axis=2)
    return np.concatenate([np.zeros((len(lines_mm), 1)), np.cumsum(steps, axis=1)], axis=1)
