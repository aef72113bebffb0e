"""The smooth wall against bodies of known shape and volume."""

import math

import numpy as np
import pytest
import trimesh
from chambers import directions, fused, sites_at, smooth, sphere, wave
from hypothesis import given, settings
from hypothesis import strategies as st

from fluoromap.fuser.chamber_shape import fit_ellipsoid, wall_surface
from fluoromap.fuser.smooth_surface import SmoothSurface, SmoothSurfaceParams
from fluoromap.fuser.surface import nearest_on_surface, volume_mm3
from fluoromap.registry import build_fuser

SEMI_AXES = np.array([20.0, 25.0, 40.0])
WHOLE = 4 / 3 * math.pi * SEMI_AXES.prod()


def exactly(count, sd_mm=0.3):
    return np.tile(sd_mm**2 * np.eye(3), (count, 1, 1))


def test_registry_builds_it():
    assert isinstance(build_fuser("smooth-surface", {"fill_mm": 12}), SmoothSurface)


def test_every_parameter_is_described():
    properties = SmoothSurfaceParams.model_json_schema()["properties"]
    assert all("description" in entry and "default" in entry for entry in properties.values())


@settings(max_examples=6, deadline=None)
@given(st.integers(4, 60), st.integers(0, 10_000), st.floats(0.1, 4.0))
def test_any_sites_make_a_closed_outward_surface_that_keeps_them_all(count, seed, sd_mm):
    tips = np.random.default_rng(seed).normal(scale=[20, 12, 30], size=(count, 3))
    vertices, faces = wall_surface(tips, exactly(count, sd_mm), 6.0)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert np.isfinite(nearest_on_surface(vertices, faces, tips).distance_mm).all()


@pytest.mark.parametrize("count", [12, 20, 40])
def test_volume_is_far_nearer_to_the_truth_than_the_hulls(count):
    tips = directions(count) * SEMI_AXES + 0.5 * np.random.default_rng(count).normal(size=(count, 3))
    hull = fused(sites_at(tips, tips[:, 0]), edge_mm=7).volume_ml * 1e3
    wall = volume_mm3(*wall_surface(tips, exactly(count, 0.5), 4.0))
    assert abs(wall - WHOLE) < 0.3 * abs(hull - WHOLE)


def test_the_ellipsoid_of_an_ellipsoid():
    found = fit_ellipsoid(directions(60) * SEMI_AXES + [5.0, -8.0, 3.0], exactly(60))
    np.testing.assert_allclose(found.centre_mm, [5, -8, 3], atol=0.5)
    np.testing.assert_allclose(np.linalg.eigvalsh(found.shape_mm), SEMI_AXES, rtol=0.03)


def test_turning_the_sites_turns_the_ellipsoid():
    tips = np.random.default_rng(0).normal(size=(9, 3)) * 20
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    found, turned = fit_ellipsoid(tips, exactly(9)), fit_ellipsoid(tips @ turn.T, exactly(9))
    np.testing.assert_allclose(turned.shape_mm, turn @ found.shape_mm @ turn.T, atol=0.02)
    np.testing.assert_allclose(turned.centre_mm, turn @ found.centre_mm, atol=0.02)


def test_a_waist_stays_a_waist():
    unit = directions(80)
    tips = unit * [22, 22, 45] * (1 - 0.35 * np.exp(-((unit[:, 2:] / 0.35) ** 2)))
    vertices, faces = wall_surface(tips, exactly(80), 3.0)
    waist = np.hypot(*vertices[np.abs(vertices[:, 2]) < 3, :2].T)
    assert waist.mean() == pytest.approx(0.65 * 22, abs=1.0)
    assert volume_mm3(vertices, faces) < 0.95 * trimesh.convex.convex_hull(vertices).volume


def test_a_sure_site_is_passed_closer_than_a_doubtful_one():
    tips = 25 * directions(20)
    tips[7] *= 1.2
    distances = []
    for sd in (0.3, 3.0):
        covariance = exactly(20)
        covariance[7] = sd**2 * np.eye(3)
        surface = wall_surface(tips, covariance, 3.0)
        distances.append(nearest_on_surface(*surface, tips).distance_mm[7])
    assert distances[0] < 2.0
    assert distances[1] > distances[0] + 1.0


def test_only_the_doubt_across_the_wall_counts():
    tips = 25 * directions(20)
    tips[0] *= 1.2
    normal = np.outer(tips[0], tips[0]) / (tips[0] @ tips[0])
    along, across = exactly(20), exactly(20)
    along[0] += 9 * (np.eye(3) - normal)
    across[0] += 9 * normal
    near, far = (nearest_on_surface(*wall_surface(tips, c, 3.0), tips).distance_mm[0] for c in (along, across))
    assert near < far - 1.0


@pytest.mark.parametrize("seed", range(3))
def test_times_lie_near_the_truth_and_within_their_deviation(seed):
    sites, truth = wave(20, seed)
    chamber = smooth(sites, edge_mm=4)
    surface = np.array([site.surface_mm for site in chamber.sites])
    nearest = np.linalg.norm(chamber.vertices_mm[None] - surface[:, None], axis=2).argmin(axis=1)
    error = chamber.lat_ms[nearest] - truth
    assert np.median(np.abs(error)) < 3.0
    assert np.mean(np.abs(error) < 2 * chamber.lat_sd_ms[nearest] + 0.8) > 0.8


def test_a_doubtful_place_makes_a_doubtful_time():
    tips = 25 * directions(30)
    slopes = sites_at(tips, 2.0 * tips[:, 0])
    doubtful = tuple(
        type(site)(site.site, site.tip_mm, 9 * np.eye(3), site.axis, 4.0, site.lat_ms, 1.0) for site in slopes
    )
    sure, unsure = smooth(slopes, edge_mm=5), smooth(doubtful, edge_mm=5)
    assert np.median(unsure.lat_sd_ms[unsure.covered]) > 1.5 * np.median(sure.lat_sd_ms[sure.covered])


def test_same_sites_make_the_same_map():
    first, second = smooth(sphere(12), edge_mm=5), smooth(sphere(12), edge_mm=5)
    for name in ("vertices_mm", "faces", "lat_ms", "lat_sd_ms", "covered"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_two_hundred_sites():
    chamber = smooth(sphere(200), edge_mm=5)
    assert chamber.coverage == 1.0
    assert chamber.volume_ml == pytest.approx(4 / 3 * math.pi * 2.5**3, rel=0.02)
