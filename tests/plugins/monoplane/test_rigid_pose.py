"""The rigid pose against truth and the Cramer-Rao bound; and its refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter
from fluoromap.contracts import ElectrodePoint, MonoplaneView, NamedChain, Observation, Refusal, Silent
from fluoromap.monoplane.rigid_pose import RigidPose, follow_body, pose_covariance_mm2, rotation_of, solve_poses
from fluoromap.reasons import Reason


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_rotation_of_a_vector_is_the_matrix_exponential(vector: list[float]) -> None:
    x, y, z = vector
    generator = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    assert rotation_of(np.array([vector]))[0] == pytest.approx(expm(generator), abs=1e-12)


def body_positions(simulation, rotations, centres):  # type: ignore[no-untyped-def]
    body = simulation.points_mm[0]
    return (body - body.mean(axis=0)) @ np.swapaxes(rotations, 1, 2) + centres[:, None]


@pytest.mark.parametrize("view", ["AP", "LAT"])
@pytest.mark.parametrize("helix", ["H18", "H77"])
@pytest.mark.parametrize("frames", [3, 30])
def test_without_noise_every_start_in_depth_gives_the_truth(simulate, helix: str, view: str, frames: int) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate(helix, view, frames)
    seen = np.ones(simulation.pixels_uv.shape[:2], dtype=bool)
    for depth_step_mm in range(6):
        poses = follow_body(
            simulation.camera, simulation.points_mm[0], simulation.pixels_uv, seen, 0, float(depth_step_mm), 6
        )
        assert np.abs(body_positions(simulation, *poses) - simulation.points_mm).max() <= 1e-8


@pytest.mark.parametrize(("helix", "view"), [("H18", "AP"), ("H18", "LAT"), ("H77", "AP"), ("H77", "LAT")])
@pytest.mark.parametrize("noise_px", [0.25, 1.0])
def test_under_noise_it_reaches_the_cramer_rao_bound(simulate, helix: str, view: str, noise_px: float) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate(helix, view, 2)
    rng = np.random.default_rng(11)
    batch = 4000
    truth = simulation.points_mm[1]
    body = simulation.points_mm[0]
    pixels = simulation.pixels_uv[1] + rng.normal(0, noise_px, (batch, 30, 2))
    start = np.broadcast_to(np.eye(3), (batch, 3, 3)), np.broadcast_to(body.mean(axis=0), (batch, 3))
    found = body_positions(
        simulation, *solve_poses(simulation.camera, body - body.mean(axis=0), pixels, start[0], start[1], 5)
    )
    rms = np.sqrt(((found - truth) ** 2).sum(axis=2).mean())
    covariance = pose_covariance_mm2(
        simulation.camera, truth, truth.mean(axis=0),
        np.broadcast_to(noise_px**2 * np.eye(2), (30, 2, 2)), np.ones(30, dtype=bool),
    )  # fmt: skip
    bound = np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean())
    assert 0.95 <= rms / bound <= 1.05


@pytest.mark.parametrize(("helix", "most_mm"), [("H18", 0.42), ("H77", 0.12)])
def test_the_error_stays_at_the_bound_through_thirty_frames(simulate, helix: str, most_mm: float) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate(helix, "LAT", 30)
    rng = np.random.default_rng(12)
    seen = np.ones((30, 30), dtype=bool)
    noise = np.broadcast_to(0.25 * np.eye(2), (30, 2, 2))
    bound = np.array([
        np.trace(pose_covariance_mm2(simulation.camera, at, at.mean(axis=0), noise, seen[0]), axis1=1, axis2=2).mean()
        for at in simulation.points_mm
    ])  # fmt: skip
    squared = np.zeros(30)
    trials = 15
    for _ in range(trials):
        pixels = simulation.pixels_uv + rng.normal(0, 0.5, simulation.pixels_uv.shape)
        poses = follow_body(simulation.camera, simulation.points_mm[0], pixels, seen, 0, 0.0, 4)
        squared += ((body_positions(simulation, *poses) - simulation.points_mm) ** 2).sum(axis=2).mean(axis=1) / trials
    assert np.sqrt(squared.mean()) <= most_mm
    # One number of a frame dominates, its depth: 150 of them scatter by 6 %.
    for part in (slice(0, 10), slice(20, 30)):
        assert np.sqrt(squared[part].mean() / bound[part].mean()) == pytest.approx(1, abs=0.2)


BODY = Catalogue(
    (Catheter("mapping", 30, (5.0,) * 29, 4, 1.3), *DEFAULT_CATALOGUE.catheters[:2]), "reference", "mapping"
)


def view(simulation, points, pixels, sd_mm: float = 1e-3, seen=None) -> MonoplaneView:  # type: ignore[no-untyped-def]
    n, m = pixels.shape[:2]
    seen = np.ones((n, m), dtype=bool) if seen is None else seen
    covariance = sd_mm**2 * np.eye(3)
    a_priori = tuple(
        ElectrodePoint("mapping", k + 1, points[k], covariance, None, None, (0.1, 0.1), 90.0) for k in range(m)
    )
    observations = tuple(
        Observation(
            f, None,
            (
                NamedChain(
                    "mapping", tuple((np.flatnonzero(seen[f]) + 1).tolist()), pixels[f][seen[f]],
                    np.broadcast_to(0.25 * np.eye(2), (int(seen[f].sum()), 2, 2)),
                ),
            ),
        )
        for f in range(n)
    )  # fmt: skip
    return MonoplaneView("S01", "a", simulation.camera, BODY, np.arange(n) * 16.7, observations, a_priori, 0, None, ())


def test_a_rigid_body_is_followed_with_honest_covariances(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 12)
    rng = np.random.default_rng(13)
    inside = []
    for _ in range(12):
        pixels = simulation.pixels_uv + rng.normal(0, 0.5, simulation.pixels_uv.shape)
        track = RigidPose(RigidPose.Params(gantry_angle_sd_deg=0)).follow(
            view(simulation, simulation.points_mm[0], pixels), Silent()
        )
        error = track.positions_mm - simulation.points_mm
        squared = np.einsum("nmi,nmij,nmj->nm", error, np.linalg.inv(track.covariance_mm2), error)
        inside.append((squared <= 7.815).mean())
    assert track.located.all()
    assert track.reasons == ((),) * 30
    assert 0.90 <= np.mean(inside) <= 0.99


def test_hidden_electrodes_are_not_located_and_hidden_frames_do_not_end_the_track(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 6)
    seen = np.ones((6, 30), dtype=bool)
    seen[2, 5] = False
    seen[3, 2:] = False
    track = RigidPose(RigidPose.Params()).follow(
        view(simulation, simulation.points_mm[0], simulation.pixels_uv, seen=seen), Silent()
    )
    assert not track.located[2, 5]
    assert track.located[2].sum() == 29
    assert not track.located[3].any()
    assert track.positions_mm[5] == pytest.approx(simulation.points_mm[5], abs=1e-6)
    assert track.reasons[5] == (Reason.TRACK_INTERRUPTED,)


def refusal_of(view: MonoplaneView) -> Refusal:
    with pytest.raises(Refusal) as refusal:
        RigidPose(RigidPose.Params()).follow(view, Silent())
    return refusal.value


def test_a_body_that_bends_is_refused(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 8)
    bent = simulation.points_mm.copy()
    bent[:, :10] += np.linspace(0, 4, 8)[:, None, None] * np.array([1.0, -1, 0])
    refusal = refusal_of(view(simulation, bent[0], simulation.camera.project(bent)))
    assert refusal.reason is Reason.DEPTH_UNOBSERVABLE
    assert "rigid body" in str(refusal)


def test_one_catheter_alone_is_refused_with_the_bound(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 4)
    arc = np.array([0.0, 4.65, 10.95, 14.25]) / 30
    points = np.stack([30 * np.sin(arc), 30 * (1 - np.cos(arc)), np.zeros(4)], axis=1) + np.array([10.0, 5.0, 0.0])
    moved = points + np.arange(4)[:, None, None] * np.array([0.5, 0.5, 0.5])
    refusal = refusal_of(view(simulation, points, simulation.camera.project(moved)))
    assert refusal.reason is Reason.DEPTH_UNOBSERVABLE
    bound = float(str(refusal).split("better than ")[1].split(" mm")[0])
    assert 20 < bound < 1000


@pytest.mark.parametrize("count", [3, 4])
def test_too_few_points_or_points_on_a_line_are_refused(simulate, count: int) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 3)
    points = np.arange(count)[:, None] * np.array([3.0, 1.0, 2.0])
    if count == 3:
        points = points + np.eye(3) * 5
    pixels = np.broadcast_to(simulation.camera.project(points), (3, count, 2))
    refusal = refusal_of(view(simulation, points, pixels))
    assert refusal.reason is Reason.DEPTH_UNOBSERVABLE
    assert "four electrodes" in str(refusal)


def test_an_uncertain_shape_counts_against_the_bound(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 4)
    exact = RigidPose(RigidPose.Params()).follow(
        view(simulation, simulation.points_mm[0], simulation.pixels_uv), Silent()
    )
    vague = RigidPose(RigidPose.Params()).follow(
        view(simulation, simulation.points_mm[0], simulation.pixels_uv, sd_mm=0.4), Silent()
    )
    assert vague.covariance_mm2[3, 0, 2, 2] > 4 * exact.covariance_mm2[3, 0, 2, 2]


def test_without_a_biplane_position_it_refuses(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 3)
    empty = view(simulation, simulation.points_mm[0], simulation.pixels_uv)
    empty = MonoplaneView(
        "S01", "a", simulation.camera, BODY, empty.frame_times_ms, empty.observations, (), 0, None, ()
    )
    assert refusal_of(empty).reason is Reason.NO_A_PRIORI
