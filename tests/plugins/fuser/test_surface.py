"""Hull, refinement and distances against solids of known area and volume."""

import numpy as np
import pytest
import trimesh
from chambers import directions
from hypothesis import given, settings
from hypothesis import strategies as st

from fluoromap.fuser.surface import (
    MOST_FACES,
    distance_along_surface,
    face_areas_mm2,
    hull_surface,
    is_watertight,
    nearest_on_surface,
    refine,
    volume_mm3,
)

CUBE = np.array([[x, y, z] for x in (0.0, 10.0) for y in (0.0, 10.0) for z in (0.0, 10.0)])


def test_cube_has_the_cubes_numbers_after_any_refinement():
    for edge_mm in (20.0, 4.0, 1.0):
        vertices, faces = refine(*hull_surface(CUBE), edge_mm)
        assert volume_mm3(vertices, faces) == pytest.approx(1000)
        assert face_areas_mm2(vertices, faces).sum() == pytest.approx(600)
        assert is_watertight(faces)
        edges = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2)
        assert edges.max() <= edge_mm or edge_mm > 15


def test_grid_of_coplanar_points_is_closed():
    grid = np.stack(np.meshgrid(*[np.linspace(0, 10, 4)] * 3), axis=-1).reshape(-1, 3)
    vertices, faces = refine(*hull_surface(grid), 2.0)
    assert is_watertight(faces)
    assert volume_mm3(vertices, faces) == pytest.approx(1000, rel=1e-6)


@settings(max_examples=15, deadline=None)
@given(st.integers(4, 30), st.integers(0, 10_000))
def test_any_hull_is_closed_outward_and_keeps_its_volume(count, seed):
    points = np.random.default_rng(seed).normal(scale=20, size=(count, 3))
    hull = hull_surface(points)
    vertices, faces = refine(*hull, 4.0)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(volume_mm3(*hull), rel=1e-6)
    assert mesh.volume == pytest.approx(trimesh.convex.convex_hull(points).volume, rel=1e-6)
    np.testing.assert_array_equal(vertices[: len(hull[0])], hull[0])


def test_far_coordinates_do_not_make_endless_faces():
    _, faces = refine(*hull_surface(CUBE * 1000), 1.0)
    assert len(faces) < 4 * MOST_FACES
    assert is_watertight(faces)


def test_nearest_point_agrees_with_trimesh():
    vertices, faces = refine(*hull_surface(25 * directions(30)), 8.0)
    points = np.random.default_rng(0).normal(scale=25, size=(40, 3))
    found = nearest_on_surface(vertices, faces, points)
    expected, distance, _ = trimesh.proximity.closest_point_naive(trimesh.Trimesh(vertices, faces), points)
    np.testing.assert_allclose(found.distance_mm, distance, atol=1e-9)
    np.testing.assert_allclose(found.positions_mm, expected, atol=1e-9)
    np.testing.assert_allclose(found.weights.sum(axis=1), 1)


def test_distance_runs_along_the_sphere_and_not_through_it():
    vertices, faces = refine(*hull_surface(25 * directions(600)), 2.0)
    pole = nearest_on_surface(vertices, faces, np.array([[0.0, 0.0, 25.0]]))
    reach = distance_along_surface(vertices, faces, pole, 100.0)
    great_circle = 25 * np.arccos(np.clip(vertices[:, 2] / np.linalg.norm(vertices, axis=1), -1, 1))
    assert (reach >= great_circle * 0.985 - 0.3).all()
    assert (reach <= great_circle * 1.2 + 0.5).all()
    assert np.median((reach / great_circle)[great_circle > 6]) < 1.05


def test_distance_stops_at_its_limit():
    vertices, faces = refine(*hull_surface(CUBE), 1.0)
    corner = nearest_on_surface(vertices, faces, vertices[:1])
    reach = distance_along_surface(vertices, faces, corner, 5.0)
    assert reach[0] == pytest.approx(0, abs=1e-6)
    assert np.isinf(reach[np.linalg.norm(vertices - vertices[0], axis=1) > 5]).all()
