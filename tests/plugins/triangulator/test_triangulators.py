"""Whole sites: positions, honest covariances, what is relative to the reference catheter, reasons."""

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import CHI2_95_3D, Array, MatchedSite, NamedChain, Observation, PhasePair, Silent
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.reasons import Reason
from fluoromap.triangulator.linear import Linear
from fluoromap.triangulator.maximum_likelihood import MaximumLikelihood
from fluoromap.triangulator.uncertainty import UncertaintyParams

NOISE_PX = 0.5
BOTH = pytest.mark.parametrize("plugin", [Linear, MaximumLikelihood])


def camera(primary: float, secondary: float = 0.0) -> Camera:
    return camera_from_gantry(Gantry(primary, secondary, 1000, 500, (178 / 512, 178 / 512), 512, 512))


def catheter_points(name: str, tip: Array, direction: Array) -> Array:
    along = DEFAULT_CATALOGUE[name].arc_lengths_mm
    return tip + along[:, None] * direction / np.linalg.norm(direction)


def heart(rng: np.random.Generator) -> dict[str, Array]:
    return {
        "mapping": catheter_points("mapping", rng.uniform(-25, 25, 3), rng.normal(size=3)),
        "reference": catheter_points("reference", np.array([25.0, -20.0, 10.0]), np.array([1.0, 2.0, 3.0])),
        "pacing": catheter_points("pacing", np.array([10.0, -30.0, -20.0]), np.array([2.0, -1.0, 2.0])),
    }


def observation(
    seen_by: Camera, points: dict[str, Array], rng: np.random.Generator | None = None, phase: float | None = 0.8
) -> Observation:
    chains = []
    for name, at in points.items():
        pixels = seen_by.project(at)
        if rng is not None:
            pixels = pixels + rng.normal(0, NOISE_PX, pixels.shape)
        covariance = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(at), 2, 2))
        chains.append(NamedChain(name, tuple(range(1, len(at) + 1)), pixels, covariance))
    return Observation(7, phase, tuple(chains))


def site(
    a: Observation, b: Observation, cameras: tuple[Camera, Camera], cycle: tuple[PhasePair, ...] = (), **changes: object
) -> MatchedSite:
    values: dict[str, object] = {
        "site": "S01", "camera_a": cameras[0], "camera_b": cameras[1], "diastole": PhasePair(a.phase, a, b),
        "cycle": cycle, "track_a": (a,), "track_b": (b,), "frame_times_a_ms": np.zeros(1), "frame_times_b_ms": np.zeros(1),
    }  # fmt: skip
    return MatchedSite(**{**values, **changes})  # type: ignore[arg-type]


LATERAL_AND_FRONTAL = (camera(90), camera(0))


@BOTH
def test_a_still_heart_without_noise_is_located_exactly(plugin: type) -> None:
    points = heart(np.random.default_rng(1))
    a, b = (observation(one, points) for one in LATERAL_AND_FRONTAL)
    answer = plugin(UncertaintyParams()).triangulate((site(a, b, LATERAL_AND_FRONTAL),), DEFAULT_CATALOGUE, Silent())
    (located,) = answer.sites
    assert not answer.rejected
    assert len(located.points) == 12
    assert located.reference_mm == pytest.approx(points["reference"].mean(axis=0), abs=1e-8)
    for point in located.points:
        truth = points[point.catheter][point.electrode - 1]
        assert point.position_mm == pytest.approx(truth, abs=1e-8)
        assert point.relative_mm == pytest.approx(truth - points["reference"].mean(axis=0), abs=1e-8)
        assert max(point.residual_px) < 1e-6
        assert 75 < point.ray_angle_deg <= 90
        assert point.reasons == ()
        assert (np.linalg.eigvalsh(point.covariance_mm2) > 0).all()
    assert located.point("mapping", 1) is not None


@BOTH
@pytest.mark.parametrize("cameras", [LATERAL_AND_FRONTAL, (camera(60, 15), camera(-10, -10)), (camera(45), camera(0))])
def test_ellipsoids_hold_the_truth_in_as_many_hearts_as_they_say(plugin: type, cameras: tuple[Camera, Camera]) -> None:
    """Pixel noise, beats, breathing and a wrong gantry, drawn as the parameters say; hearts, not electrodes, are counted."""
    rng = np.random.default_rng(7)
    inside, inside_relative, errors, relative_errors = [], [], [], []
    params = UncertaintyParams()
    for _ in range(150):
        points = heart(rng)
        views = []
        for one in cameras:
            breathing = rng.normal(0, [1, 1, 4]) + rng.normal(0, params.isocentre_sd_mm, 3)
            turn = np.radians(rng.normal(0, params.gantry_angle_sd_deg, 3))
            moved = {
                name: at + breathing + rng.normal(0, params.catheter_sd_mm(), 3) + np.cross(turn, at)
                for name, at in points.items()
            }
            views.append(observation(one, moved, rng))
        matched = site(views[0], views[1], cameras)
        (located,) = plugin(params).triangulate((matched,), DEFAULT_CATALOGUE, Silent()).sites
        tip = located.point("mapping", 1)
        error = tip.position_mm - points["mapping"][0]
        relative = tip.relative_mm - (points["mapping"][0] - points["reference"].mean(axis=0))
        inside.append(error @ np.linalg.solve(tip.covariance_mm2, error) <= CHI2_95_3D)
        inside_relative.append(relative @ np.linalg.solve(tip.relative_covariance_mm2, relative) <= CHI2_95_3D)
        errors.append(np.linalg.norm(error))
        relative_errors.append(np.linalg.norm(relative))
    # Of 150 draws at 95 %: 3.5 standard deviations.
    assert 0.887 <= np.mean(inside) <= 1
    assert 0.887 <= np.mean(inside_relative) <= 1
    assert np.mean(inside) < 0.9999
    assert np.median(relative_errors) < 0.5 * np.median(errors)


def test_breathing_between_the_runs_is_found_and_hardly_reaches_relative_positions() -> None:
    points = heart(np.random.default_rng(3))
    shift = np.array([0.0, 0.0, 6.0])
    a = observation(camera(90), points)
    b = observation(camera(0), {name: at + shift for name, at in points.items()})
    worst = {}
    for plugin in (Linear, MaximumLikelihood):
        answer = plugin(UncertaintyParams()).triangulate(
            (site(a, b, LATERAL_AND_FRONTAL),), DEFAULT_CATALOGUE, Silent()
        )
        (located,) = answer.sites
        worst[plugin] = max(
            np.linalg.norm(
                point.relative_mm - (points[point.catheter][point.electrode - 1] - points["reference"].mean(axis=0))
            )
            for point in located.points
        )
        if plugin is MaximumLikelihood:
            assert any("6 mm apart" in note for note in answer.notes)
    assert worst[MaximumLikelihood] < 0.1
    assert worst[MaximumLikelihood] < 0.5 * worst[Linear]


@BOTH
def test_views_less_than_twenty_degrees_apart_are_rejected_with_the_angle(plugin: type) -> None:
    cameras = (camera(19), camera(0))
    points = heart(np.random.default_rng(1))
    a, b = (observation(one, points) for one in cameras)
    answer = plugin(UncertaintyParams()).triangulate((site(a, b, cameras),), DEFAULT_CATALOGUE, Silent())
    assert not answer.sites
    assert answer.rejected[0].reasons == (Reason.VIEWS_PARALLEL,)
    assert "19 degrees" in answer.notes[0]


@BOTH
def test_without_the_reference_there_is_no_relative_position(plugin: type) -> None:
    points = heart(np.random.default_rng(1))
    a = observation(camera(90), points)
    del points["reference"]
    b = observation(camera(0), points, phase=None)
    answer = plugin(UncertaintyParams()).triangulate((site(a, b, LATERAL_AND_FRONTAL),), DEFAULT_CATALOGUE, Silent())
    (located,) = answer.sites
    assert located.reference_mm is None
    assert located.reasons == (Reason.NO_REFERENCE, Reason.PHASE_UNKNOWN)
    assert all(point.relative_mm is None and point.relative_covariance_mm2 is None for point in located.points)


@BOTH
def test_a_missing_mapping_catheter_rejects_the_site(plugin: type) -> None:
    points = heart(np.random.default_rng(1))
    a = observation(camera(90), points)
    del points["mapping"]
    b = observation(camera(0), points)
    answer = plugin(UncertaintyParams()).triangulate((site(a, b, LATERAL_AND_FRONTAL),), DEFAULT_CATALOGUE, Silent())
    assert answer.rejected[0].reasons == (Reason.CATHETER_NOT_FOUND,)


def test_a_wrong_spacing_and_matching_s_doubts_are_told_at_the_electrodes() -> None:
    points = heart(np.random.default_rng(1))
    points["mapping"] = points["mapping"].copy()
    points["mapping"][3] += 2.0 * (points["mapping"][3] - points["mapping"][2]) / 3.3
    a, b = (observation(one, points) for one in LATERAL_AND_FRONTAL)
    matched = site(a, b, LATERAL_AND_FRONTAL, notes=(("reference", Reason.IDENTITY_BY_MOTION),))
    (located,) = Linear(UncertaintyParams()).triangulate((matched,), DEFAULT_CATALOGUE, Silent()).sites
    reasons = {(point.catheter, point.electrode): point.reasons for point in located.points}
    assert reasons["mapping", 3] == reasons["mapping", 4] == (Reason.SPACING_MISMATCH,)
    assert reasons["mapping", 1] == reasons["pacing", 1] == ()
    assert reasons["reference", 1] == (Reason.IDENTITY_BY_MOTION,)


@BOTH
def test_the_cycle_follows_the_beating_heart(plugin: type) -> None:
    points = heart(np.random.default_rng(1))
    pairs, truth = [], []
    for phase in np.arange(0, 1, 0.1):
        moved = {name: at + 3 * np.sin(2 * np.pi * phase) for name, at in points.items()}
        truth.append(np.concatenate(list(moved.values())))
        a, b = (observation(one, moved, phase=float(phase)) for one in LATERAL_AND_FRONTAL)
        pairs.append(PhasePair(float(phase), a, b))
    # The same phase of another beat, and a moment that lacks a catheter, do not disturb it.
    first = pairs[0].a
    gone = Observation(3, 0.55, pairs[5].a.chains[1:])
    cycle = (pairs[0], *pairs[:6], PhasePair(0.55, gone, pairs[5].b), *pairs[6:])
    matched = site(first, pairs[0].b, LATERAL_AND_FRONTAL, cycle)
    (located,) = plugin(UncertaintyParams()).triangulate((matched,), DEFAULT_CATALOGUE, Silent()).sites
    assert located.cycle is not None
    assert located.cycle.phases == pytest.approx(np.arange(0, 1, 0.1))
    assert located.cycle.positions_mm == pytest.approx(np.array(truth), abs=1e-7)
    assert located.cycle.labels[0] == ("mapping", 1)
