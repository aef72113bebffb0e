"""Whole sites: positions, honest covariances, positions relative to the reference catheter, reasons."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import BENDS_OVER_MM, DEFAULT_CATALOGUE
from fluoromap.contracts import (
    CHI2_95_3D,
    Alternative,
    Array,
    Grade,
    MatchedRuns,
    MatchedSite,
    NamedChain,
    Observation,
    PhasePair,
    Silent,
    grade_of,
)
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.reasons import Reason
from fluoromap.triangulator.gantry_kinds import GANTRY_KINDS
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
    by: Camera, points: dict[str, Array], rng: np.random.Generator | None = None, phase: float | None = 0.8
) -> Observation:
    chains = []
    for name, at in points.items():
        pixels = by.project(at)
        if rng is not None:
            pixels = pixels + rng.normal(0, NOISE_PX, pixels.shape)
        covariance = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(at), 2, 2))
        chains.append(NamedChain(name, tuple(range(1, len(at) + 1)), pixels, covariance))
    return Observation(7, phase, tuple(chains))


def site(
    a: Observation, b: Observation, cameras: tuple[Camera, Camera], cycle: tuple[PhasePair, ...] = (),
    notes: tuple[tuple[str, Reason], ...] = (), alternative: Alternative | None = None,
) -> MatchedSite:  # fmt: skip
    pair = PhasePair(a.phase, a, b)
    return MatchedSite(
        "S01", MatchedRuns(*cameras, pair, cycle, (a,), (b,), np.zeros(1), np.zeros(1), alternative), notes
    )


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
    """Draw pixel noise, beats, breathing and gantry errors as the parameters say; count hearts, not electrodes."""
    rng = np.random.default_rng(7)
    inside, inside_relative, errors, relative_errors = [], [], [], []
    params = UncertaintyParams()
    shares = [kind.share for kind in GANTRY_KINDS]
    for _ in range(100):
        points = heart(rng)
        kind = GANTRY_KINDS[rng.choice(len(GANTRY_KINDS), p=shares)]
        centres = {name: rng.normal(0, params.tip_centre_sd_mm) for name in points}
        views, breaths = [], []
        for one in cameras:
            breaths.append(rng.normal(0, [1, 1, 4]))
            offset = kind.offset * rng.normal(0, params.isocentre_sd_mm, 3)
            turn = kind.angle * np.radians(rng.normal(0, params.gantry_angle_sd_deg, 3))
            moved = {
                name: at + breaths[-1] + offset + rng.normal(0, params.beat_sd_mm, 3) * bend(name) + np.cross(turn, at)
                for name, at in points.items()
            }
            for name, at in moved.items():
                at[0] += centres[name] * (at[0] - at[1]) / np.linalg.norm(at[0] - at[1])
            views.append(observation(one, moved, rng))
        matched = site(views[0], views[1], cameras)
        (located,) = plugin(params).triangulate((matched,), DEFAULT_CATALOGUE, Silent()).sites
        tip = located.point("mapping", 1)
        error = tip.position_mm - points["mapping"][0] - np.mean(breaths, axis=0)
        relative = tip.relative_mm - (points["mapping"][0] - points["reference"].mean(axis=0))
        inside.append(error @ np.linalg.solve(tip.covariance_mm2, error) <= CHI2_95_3D)
        inside_relative.append(relative @ np.linalg.solve(tip.relative_covariance_mm2, relative) <= CHI2_95_3D)
        errors.append(np.linalg.norm(error))
        relative_errors.append(np.linalg.norm(relative))
    # Of 100 draws at 95 %: 3.5 standard deviations.
    assert 0.874 <= np.mean(inside) < 0.9999
    assert 0.874 <= np.mean(inside_relative) < 0.9999
    assert np.median(relative_errors) < 0.7 * np.median(errors)


def bend(name: str) -> Array:
    """Return the share of its tip's displacement that each electrode follows, shape (m, 1)."""
    along = DEFAULT_CATALOGUE[name].arc_lengths_mm
    return (0.5 + 0.5 * np.exp(-along / BENDS_OVER_MM))[:, None]


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


def test_a_wrong_spacing_and_matching_s_doubts_are_reported_at_the_electrodes() -> None:
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


def beating_site(rng: np.random.Generator) -> MatchedSite:
    """Return a site with a pulse of 5 mm in systole.

    It rests in diastole.
    """
    points = heart(rng)
    pairs = []
    for phase in np.arange(0, 1, 0.05):
        pulse = 5 * np.exp(-0.5 * ((phase - 0.3) / 0.1) ** 2)
        moved = {name: at + np.array([pulse, pulse, 0]) for name, at in points.items()}
        a, b = (observation(one, moved, rng, phase=float(phase)) for one in LATERAL_AND_FRONTAL)
        pairs.append(PhasePair(float(phase), a, b))
    rest = pairs[16]
    return site(rest.a, rest.b, LATERAL_AND_FRONTAL, tuple(pairs))


@BOTH
def test_a_moment_is_less_certain_where_the_heart_moves_fast(plugin: type) -> None:
    matched = beating_site(np.random.default_rng(2))
    (located,) = plugin(UncertaintyParams()).triangulate((matched,), DEFAULT_CATALOGUE, Silent()).sites
    assert located.cycle is not None
    spread = np.trace(located.cycle.covariance_mm2, axis1=2, axis2=3).mean(axis=1)
    fast, quiet = spread[[3, 4, 8, 9]], spread[14:19]
    assert fast.min() > quiet.max() + 0.3
    assert quiet.max() < 1.1 * quiet.min()


@BOTH
def test_the_budget_adds_up_to_the_covariances(plugin: type) -> None:
    matched = beating_site(np.random.default_rng(2))
    params = UncertaintyParams(tip_centre_sd_mm=0)
    answer = plugin(params).triangulate((matched,), DEFAULT_CATALOGUE, Silent())
    budget = answer.budget
    assert budget is not None
    shares = (
        budget.pixels_mm, budget.angles_mm, budget.source_distances_mm, budget.phase_mismatch_mm, budget.breathing_mm
    )  # fmt: skip
    assert all(share > 0 for share in shares)
    stated = np.mean([np.trace(point.covariance_mm2) for point in answer.sites[0].points])
    assert np.square(shares).sum() == pytest.approx(stated, rel=1e-6)
    assert budget.pixels_mm == pytest.approx(0.137, rel=0.1)


def along_the_shaft_mm2(tip_mm: float, tip_centre_sd_mm: float) -> float:
    """Return the variance of the mapping tip along its shaft, from the reference catheter."""
    mapping = replace(DEFAULT_CATALOGUE["mapping"], tip_mm=tip_mm)
    catalogue = replace(
        DEFAULT_CATALOGUE,
        catheters=tuple(mapping if one.name == "mapping" else one for one in DEFAULT_CATALOGUE.catheters),
    )
    points = heart(np.random.default_rng(4))
    a, b = (observation(one, points) for one in LATERAL_AND_FRONTAL)
    params = UncertaintyParams(tip_centre_sd_mm=tip_centre_sd_mm)
    (located,) = MaximumLikelihood(params).triangulate((site(a, b, LATERAL_AND_FRONTAL),), catalogue, Silent()).sites
    shaft = points["mapping"][1] - points["mapping"][0]
    shaft /= np.linalg.norm(shaft)
    return float(shaft @ located.point("mapping", 1).relative_covariance_mm2 @ shaft)


@pytest.mark.parametrize(("tip_mm", "sd_mm"), [(2.0, 0.2), (4.0, 0.2), (8.0, 0.4)])
def test_the_unknown_shape_of_a_long_tip_widens_its_covariance_along_the_shaft(tip_mm: float, sd_mm: float) -> None:
    wider = along_the_shaft_mm2(tip_mm, 0.2) - along_the_shaft_mm2(tip_mm, 0.0)
    assert wider == pytest.approx(sd_mm**2, rel=0.15)


@BOTH
def test_one_electrode_in_views_twenty_two_degrees_apart_is_located_with_an_honest_depth(plugin: type) -> None:
    cameras = (camera(22), camera(0))
    tip = np.array([[12.0, -8.0, 15.0]])
    a, b = (observation(one, {"mapping": tip}) for one in cameras)
    (located,) = plugin(UncertaintyParams()).triangulate((site(a, b, cameras),), DEFAULT_CATALOGUE, Silent()).sites
    (point,) = located.points
    assert point.position_mm == pytest.approx(tip[0], abs=1e-6)
    assert point.relative_mm is None
    assert grade_of(point.covariance_mm2) is Grade.C
    depth = np.linalg.eigh(point.covariance_mm2)[1][:, -1]
    middle = cameras[0].axis_world + cameras[1].axis_world
    assert abs(depth @ middle) / np.linalg.norm(middle) > 0.98


@BOTH
def test_views_that_contradict_each_other_are_doubted_or_rejected_but_never_without_numbers(plugin: type) -> None:
    rng = np.random.default_rng(3)
    points = heart(rng)
    a = observation(camera(90), points)
    nonsense = {name: rng.uniform(-40, 40, at.shape) for name, at in points.items()}
    b = observation(camera(0), nonsense)
    answer = plugin(UncertaintyParams()).triangulate((site(a, b, LATERAL_AND_FRONTAL),), DEFAULT_CATALOGUE, Silent())
    if answer.sites:
        doubts = {reason for point in answer.sites[0].points for reason in point.reasons} | {*answer.sites[0].reasons}
        assert doubts & {Reason.GEOMETRY_DOUBTFUL, Reason.SPACING_MISMATCH}
    else:
        assert {*answer.rejected[0].reasons} & {Reason.PAIRING_FAILED, Reason.GEOMETRY_DOUBTFUL}
    if plugin is MaximumLikelihood:
        # Every catheter's spacing is wrong then: neither names nor scale can be trusted.
        assert answer.sites == ()
        assert answer.rejected[0].reasons == (Reason.SPACING_MISMATCH, Reason.GEOMETRY_DOUBTFUL)


@BOTH
def test_another_pairing_that_cannot_be_ruled_out_widens_the_ellipsoid_and_lowers_the_grade(plugin: type) -> None:
    points = heart(np.random.default_rng(1))
    a, b = (observation(one, points) for one in LATERAL_AND_FRONTAL)
    exchanged = {"reference": points["pacing"], "pacing": points["reference"], "mapping": points["mapping"]}
    other = observation(LATERAL_AND_FRONTAL[1], exchanged)
    plain = site(a, b, LATERAL_AND_FRONTAL)
    unsure = site(a, b, LATERAL_AND_FRONTAL, alternative=Alternative(PhasePair(0.8, a, other), 0.3))
    before, after = (
        plugin(UncertaintyParams(gantry_angle_sd_deg=0.25)).triangulate((one,), DEFAULT_CATALOGUE, Silent()).sites[0]
        for one in (plain, unsure)
    )
    for name in ("reference", "pacing"):
        first, second = before.point(name, 2), after.point(name, 2)
        assert second.position_mm == pytest.approx(first.position_mm)
        apart = second.alternative_mm - second.position_mm
        assert second.alternative_probability == 0.3
        assert np.linalg.norm(apart) > 5
        assert apart @ second.covariance_mm2 @ apart > 0.3 * (apart @ apart) ** 2
        assert Reason.IDENTITY_UNCERTAIN in second.reasons
    tip = after.point("mapping", 1)
    assert tip.alternative_mm is None
    assert tip.reasons == ()
    assert tip.covariance_mm2 == pytest.approx(before.point("mapping", 1).covariance_mm2)
    # The reference may be the other catheter: then every relative position changes with it.
    assert grade_of(before.point("mapping", 1).relative_covariance_mm2) is Grade.A
    assert grade_of(tip.relative_covariance_mm2) is Grade.C
