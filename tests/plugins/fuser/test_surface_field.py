"""The eigenfunctions of a surface."""

from __future__ import annotations

import numpy as np

from fluoromap.fuser.chamber_shape import wall_surface
from fluoromap.fuser.surface_field import SurfaceField

AXES_MM = np.array([20.0, 24.0, 32.0])


def test_the_eigenfunctions_of_a_wall_are_orthonormal_and_the_same_each_time() -> None:
    directions = np.random.default_rng(2).normal(size=(20, 3))
    tips = AXES_MM * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    vertices, faces = wall_surface(tips, np.tile(0.1 * np.eye(3), (20, 1, 1)), 3.0)
    field = SurfaceField(vertices, faces)
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    mass = np.bincount(faces.ravel(), np.repeat(areas / 3, 3), minlength=len(vertices))
    np.testing.assert_allclose(field.modes.T @ (mass[:, None] * field.modes), np.eye(field.modes.shape[1]), atol=1e-9)
    np.testing.assert_array_equal(field.modes, SurfaceField(vertices, faces).modes)
