"""The paper's chamber against known fields, shapes and waves."""

import math

import numpy as np
import pytest
import trimesh
from chambers import directions, fused, sites_at, sphere, wave
from pydantic import ValidationError

from fluoromap.fuser.activation_times import LEAST_SD_MS
from fluoromap.fuser.convex_hull import ConvexHull, ConvexHullParams
from fluoromap.reasons import Reason
from fluoromap.registry import build_fuser

TETRAHEDRON = np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [0, 0, 30]])


def times_at_sites(chamber):
    """Return map times at each site, from the nearest vertex.

    Sites on the hull are vertices.
    """
    surface = np.array([site.surface_mm for site in chamber.sites])
    nearest = np.linalg.norm(chamber.vertices_mm[None] - surface[:, None], axis=2).argmin(axis=1)
    return chamber.lat_ms[nearest]


def test_registry_builds_it():
    assert isinstance(build_fuser("convex-hull", {"fill_mm": 12}), ConvexHull)


@pytest.mark.parametrize("wrong", [{"fill_mm": 0}, {"tip_point": "middle"}, {"edge_mm": 0.01}, {"colour": "red"}])
def test_params_are_bounded_and_closed(wrong):
    with pytest.raises(ValidationError):
        ConvexHullParams.model_validate(wrong)


def test_every_parameter_is_described():
    properties = ConvexHullParams.model_json_schema()["properties"]
    assert all("description" in entry and "default" in entry for entry in properties.values())


def test_surface_is_closed_and_outward(ball):
    mesh = trimesh.Trimesh(ball.vertices_mm, ball.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert ball.volume_ml == pytest.approx(mesh.volume / 1e3)
    assert ball.area_cm2 == pytest.approx(mesh.area / 1e2)


def test_hull_lies_within_the_sphere_and_nears_it_with_more_sites(ball):
    whole = 4 / 3 * math.pi * 2.5**3
    larger = fused(sphere(150), edge_mm=7)
    # A polytope of n vertices in a ball misses about 9.1 / n of its volume (n large).
    assert 0.65 * whole < ball.volume_ml < whole
    assert 0.92 * whole < larger.volume_ml < whole


def test_linear_field_is_recovered(ball):
    assert ball.covered.all()
    error = ball.lat_ms - (ball.vertices_mm[:, 0] - 10)
    assert np.abs(error).max() < 2.0
    assert np.sqrt(np.mean(error**2)) < 0.7
    assert ball.leave_one_out_rms_ms < 2.0


def test_negative_times_stay_negative(ball):
    assert ball.lat_ms.min() < -20
    assert ball.total_activation_time_ms == pytest.approx(np.ptp([site.lat_ms for site in ball.sites]))


@pytest.mark.parametrize("seed", range(4))
def test_times_at_the_sites_are_kept_within_their_error(seed):
    sites, _ = wave(20, seed, lat_sd_ms=2.0)
    chamber = fused(sites)
    on_hull = np.array([site.distance_mm < 1e-9 for site in chamber.sites])
    difference = times_at_sites(chamber) - [site.lat_ms for site in sites]
    assert on_hull.sum() >= 12
    assert np.sqrt(np.mean(difference[on_hull] ** 2)) < 2.0
    assert np.abs(difference[on_hull]).max() < 6.0


def test_standard_deviation_covers_the_truth_and_grows_away_from_sites():
    within, near, far = [], [], []
    for seed in range(4):
        sites, _ = wave(20, seed)
        _, truth = wave(20, seed, lat_sd_ms=0.0)
        chamber = fused(sites, edge_mm=4)
        others = np.array([site.leave_one_out_error_ms for site in chamber.sites])
        assert np.isfinite(others).all()
        difference = times_at_sites(chamber) - truth
        nearest = np.linalg.norm(
            chamber.vertices_mm[None] - np.array([s.surface_mm for s in chamber.sites])[:, None], axis=2
        )
        sd = chamber.lat_sd_ms[nearest.argmin(axis=1)]
        within += (np.abs(difference) < 2 * np.maximum(sd, LEAST_SD_MS)).tolist()
        reach = nearest.min(axis=0)
        near.append(chamber.lat_sd_ms[chamber.covered & (reach < 3)].mean())
        far.append(chamber.lat_sd_ms[chamber.covered & (reach > 10)].mean())
    assert np.mean(within) > 0.85
    assert np.mean(far) > 1.2 * np.mean(near)


def test_no_site_is_lost_inside_the_hull():
    tips = np.vstack([25 * directions(20), [[0.0, 0.0, 18.0], [5.0, 0.0, 0.0]]])
    chamber = fused(sites_at(tips, tips[:, 2]))
    assert [site.site for site in chamber.sites] == [f"S{index + 1:02d}" for index in range(22)]
    mesh = trimesh.Trimesh(chamber.vertices_mm, chamber.faces, process=False)
    for site, tip in zip(chamber.sites, tips, strict=True):
        np.testing.assert_allclose(site.position_mm, tip)
        assert site.distance_mm == pytest.approx(np.linalg.norm(site.surface_mm - tip), abs=1e-9)
    surface = np.array([site.surface_mm for site in chamber.sites])
    assert np.abs(trimesh.proximity.closest_point_naive(mesh, surface)[1]).max() < 1e-6
    assert chamber.sites[20].distance_mm > 2
    assert chamber.sites[0].distance_mm == 0


def test_only_what_is_near_a_site_is_coloured(sparse_ball):
    chamber = sparse_ball
    surface = np.array([site.surface_mm for site in chamber.sites])
    straight = np.linalg.norm(chamber.vertices_mm[:, None] - surface[None], axis=2).min(axis=1)
    assert not chamber.covered[straight > 10].any()
    assert chamber.covered[straight < 8].all()
    assert 0.2 < chamber.coverage < 0.9
    assert (chamber.lat_ms[~chamber.covered] == 0).all()
    assert fused(sphere(10), fill_mm=20).coverage > chamber.coverage


def test_colour_does_not_reach_through_a_thin_chamber():
    rim = np.array([[30 * math.cos(a), 30 * math.sin(a), z] for a in np.arange(0, 6.2, 0.7) for z in (0.0, 6.0)])
    tips = np.vstack([rim, [[0.0, 0.0, 7.0]]])
    chamber = fused(sites_at(tips, np.zeros(len(tips))), fill_mm=10)
    below = (chamber.vertices_mm[:, 2] < 0.1) & (np.hypot(*chamber.vertices_mm[:, :2].T) < 8)
    assert below.any()
    assert not chamber.covered[below].any()


@pytest.mark.parametrize("error_ms", [70.0, -70.0, 150.0])
def test_outlier_is_reported_and_colours_nothing(error_ms):
    sites, _ = wave(20, 1)
    clean = fused(sites, edge_mm=5)
    tips, times = np.array([site.tip_mm for site in sites]), np.array([site.lat_ms for site in sites])
    times[6] += error_ms
    spoilt = sites_at(tips, times, 1.5)
    chamber = fused(spoilt, edge_mm=5)
    assert [site.site for site in chamber.sites if Reason.LAT_OUTLIER in site.reasons] == ["S07"]
    assert chamber.warnings == (Reason.LAT_OUTLIER,)
    assert chamber.sites[6].lat_ms == times[6]
    assert abs(chamber.sites[6].leave_one_out_error_ms + error_ms) < 20
    both = clean.covered & chamber.covered
    assert np.abs(clean.lat_ms - chamber.lat_ms)[both].max() < 25
    assert "S07" not in dict(chamber.earliest)


def test_a_focus_is_no_outlier():
    for seed in range(8):
        assert fused(wave(20, seed)[0], edge_mm=7).warnings == ()


def test_tip_end_lies_half_a_tip_further_out():
    centre, end = fused(sphere(20), edge_mm=7), fused(sphere(20), edge_mm=7, tip_point="end")
    for inner, outer, site in zip(centre.sites, end.sites, sphere(20), strict=True):
        np.testing.assert_allclose(outer.position_mm - inner.position_mm, 2.0 * site.axis)
    assert end.volume_ml > centre.volume_ml


def test_four_sites_are_enough():
    chamber = fused(sites_at(TETRAHEDRON, np.array([0.0, 10, 20, 30])))
    assert chamber.volume_ml == pytest.approx(30**3 / 6 / 1e3)
    assert all(site.distance_mm == 0 for site in chamber.sites)
    assert times_at_sites(chamber) == pytest.approx([0, 10, 20, 30], abs=1.0)


def test_same_sites_make_the_same_map():
    first, second = fused(sphere(12)), fused(sphere(12))
    for name in ("vertices_mm", "faces", "lat_ms", "lat_sd_ms", "covered"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_repeated_places_and_equal_exact_times():
    sites = sphere(12)
    doubled = (
        *sites,
        *sites_at(np.array([site.tip_mm for site in sites[:3]]), np.array([s.lat_ms for s in sites[:3]])),
    )
    assert np.isfinite(fused(doubled).lat_ms).all()
    still = fused(sites_at(np.array([site.tip_mm for site in sites]), np.zeros(12), 0.0))
    assert np.abs(still.lat_ms).max() < 0.1
    assert still.total_activation_time_ms == 0
