"""The eigenfunctions of a surface."""

from __future__ import annotations

import numpy as np
import pytest

from fluoromap.fuser.chamber_shape import wall_surface
from fluoromap.fuser.surface_field import SurfaceField, _largest_eigenpairs

AXES_MM = np.array([20.0, 24.0, 32.0])


@pytest.mark.parametrize(("size", "count"), [(400, 30), (60, 20)])
def test_the_largest_eigenpairs_are_those_of_the_whole_matrix(size: int, count: int) -> None:
    rng = np.random.default_rng(1)
    axes = np.linalg.qr(rng.normal(size=(size, size)))[0]
    values = 1.0 / np.arange(1.0, size + 1)
    matrix = (axes * values) @ axes.T
    found, vectors = _largest_eigenpairs(lambda of: matrix @ of, np.ones(size), count)
    np.testing.assert_allclose(found, values[:count], rtol=1e-12)
    np.testing.assert_allclose(np.abs((vectors * axes[:, :count]).sum(axis=0)), 1.0, atol=1e-12)


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
