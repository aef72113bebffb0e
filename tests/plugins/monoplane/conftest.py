"""The paper's simulation: a helix of 30 points that moves 0.5 degrees about each axis and 1 mm along each, frame after frame."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from fluoromap.contracts import Array
from fluoromap.geometry import Camera

FOCAL_PX = 1000 / (178 / 512)


@dataclass(frozen=True, eq=False)
class Simulation:
    """World points (n, 30, 3), their pixels (n, 30, 2) and the camera."""

    camera: Camera
    points_mm: Array
    pixels_uv: Array


def _rotation(axis: int, degrees: float) -> Array:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def helix(radius: float, length: float, axis: int, centre: tuple[float, float, float]) -> Array:
    """Return 30 points over 2 right-handed turns.

    They begin at phase 0 and include both ends.
    """
    t = np.linspace(0, 1, 30)
    points = np.empty((30, 3))
    points[:, (axis + 1) % 3] = radius * np.cos(4 * np.pi * t)
    points[:, (axis + 2) % 3] = radius * np.sin(4 * np.pi * t)
    points[:, axis] = length * (t - 0.5)
    return points + centre


HELICES = {"H77": helix(77, 250, 2, (-12, -15, -19)), "H18": helix(18, 60, 1, (-12, -13, -16))}
ROTATIONS = {"AP": np.eye(3), "LAT": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])}


@pytest.fixture(scope="session")
def simulate() -> Callable[[str, str, int], Simulation]:
    """Return a function (helix, view, frames) -> simulation.

    The cameras are right-handed, 500 mm from the isocentre, with c = (256, 256).
    """

    def build(name: str, view: str, frames: int) -> Simulation:
        intrinsic = np.array([[FOCAL_PX, 0, 256], [0, FOCAL_PX, 256], [0, 0, 1]])
        camera = Camera(intrinsic @ np.column_stack([ROTATIONS[view], [0, 0, 500]]), 512, 512)
        turn = _rotation(2, 0.5) @ _rotation(1, 0.5) @ _rotation(0, 0.5)
        points = [HELICES[name]]
        for _ in range(frames - 1):
            points.append(points[-1] @ turn.T + 1.0)
        array = np.array(points)
        return Simulation(camera, array, camera.project(array))

    return build
