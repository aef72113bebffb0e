"""The paper's simulation: a helix of 30 points that rotates and moves between images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from fluoromap.contracts import Array
from fluoromap.geometry import Camera

HelixName = Literal["H77", "H18"]
HelixView = Literal["LAT", "AP"]

POINTS = 30
TURNS = 2.0
STEP_DEG = 0.5
STEP_MM = 1.0
_FOCAL_PX = 1000.0 / (178.0 / 512.0)
_SOURCE_ISOCENTRE_MM = 500.0
_PRINCIPAL_PX = 256.0
_SIZE_PX = 512
# World to camera; right-handed, unlike a C-arm's view: the paper's simulation looks along +Z (AP) and +X (LAT).
_ROTATIONS: dict[HelixView, Array] = {
    "AP": np.eye(3),
    "LAT": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
}


@dataclass(frozen=True, slots=True)
class Helix:
    """A helix: radius and length in mm, the world axis (0, 1, 2) of its windings, and its centre in mm."""

    radius_mm: float
    length_mm: float
    axis: int
    centre_mm: tuple[float, float, float]

    def points_mm(self) -> Array:
        """Return the points (30, 3), world mm: right-handed, from phase 0, both ends included."""
        along = np.linspace(0.0, 1.0, POINTS)
        angle = 2 * np.pi * TURNS * along
        points = np.empty((POINTS, 3))
        points[:, (self.axis + 1) % 3] = self.radius_mm * np.cos(angle)
        points[:, (self.axis + 2) % 3] = self.radius_mm * np.sin(angle)
        points[:, self.axis] = self.length_mm * (along - 0.5)
        return points + self.centre_mm


HELICES: dict[HelixName, Helix] = {
    "H77": Helix(77.0, 250.0, 2, (-12.0, -15.0, -19.0)),
    "H18": Helix(18.0, 60.0, 1, (-12.0, -13.0, -16.0)),
}
"""The paper describes no helix. H77 was fitted to its Table 1 and lies outside the field of view; H18 would fit into a
heart."""


def helix_camera(view: HelixView) -> Camera:
    """Return the camera of a view.

    The source is 500 mm from the isocentre and 1000 mm from the detector of 178 mm over 512 px; the principal point is
    (256, 256).
    """
    inner = np.array([[_FOCAL_PX, 0.0, _PRINCIPAL_PX], [0.0, _FOCAL_PX, _PRINCIPAL_PX], [0.0, 0.0, 1.0]])
    return Camera(inner @ np.column_stack([_ROTATIONS[view], [0.0, 0.0, _SOURCE_ISOCENTRE_MM]]), _SIZE_PX, _SIZE_PX)


def next_points_mm(points_mm: Array) -> Array:
    """Move points (m, 3) to the next image, eq. (11) of the paper: X' = R X + T.

    R rotates by 0.5 degrees about X, then Y, then Z, around the isocentre; T is 1 mm along each axis.
    """
    turn = Rotation.from_euler("xyz", [STEP_DEG] * 3, degrees=True).as_matrix()
    later: Array = points_mm @ turn.T + STEP_MM
    return later


def motion_mm(helix: Helix, images: int) -> Array:
    """Return the points of a helix in successive images, shape (images, 30, 3)."""
    points = [helix.points_mm()]
    for _ in range(images - 1):
        points.append(next_points_mm(points[-1]))
    return np.array(points)
