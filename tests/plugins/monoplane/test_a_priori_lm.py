"""The paper's monoplane method: its equations and its lack of depth. tables/ tests Table 1."""

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import ElectrodePoint, MonoplaneView, NamedChain, Observation, Refusal, Silent
from fluoromap.monoplane.a_priori_lm import (
    APrioriLM,
    column_residual,
    distance_residual,
    motion_variance_share,
    row_residual,
    start_displacement,
    track_points,
)
from fluoromap.reasons import Reason


def track(simulation, depth_step_mm: float, start: int = 0):  # type: ignore[no-untyped-def]
    visible = np.ones(simulation.pixels_uv.shape[:2], dtype=bool)
    return track_points(
        simulation.camera, simulation.points_mm[start], simulation.pixels_uv, visible, start, depth_step_mm
    )


@pytest.mark.parametrize("view", ["AP", "LAT"])
def test_depth_of_the_answer_is_the_depth_of_the_start(simulate, view: str) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", view, 4)
    camera = simulation.camera
    for dz in (0.0, 2.0):
        found = track(simulation, dz)
        # Across the ray the image decides.
        assert camera.project(found) == pytest.approx(simulation.pixels_uv, abs=1e-5)
        # Along it the start value comes out, up to the slant of the ray.
        assert np.diff(camera.depth_mm(found), axis=0) == pytest.approx(dz, abs=0.25)


def test_the_sequence_runs_to_both_ends(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 7)
    found = track(simulation, 1.0, start=3)
    assert found[3] == pytest.approx(simulation.points_mm[3], abs=1e-9)
    # With the true displacement as start value both directions stay near the truth.
    assert np.linalg.norm(found - simulation.points_mm, axis=2).max() < 3.5
    assert camera_depth_falls_backwards(simulation, found)


def camera_depth_falls_backwards(simulation, found) -> bool:  # type: ignore[no-untyped-def]
    depth = simulation.camera.depth_mm(found).mean(axis=1)
    return bool((np.diff(depth) > 0.8).all())


@pytest.mark.parametrize("equation", ["8", "9", "10"])
def test_equations_8_9_10_vanish_at_the_truth_and_have_their_gradients(simulate, equation: str) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "LAT", 2)
    camera, points = simulation.camera, simulation.points_mm[1]
    before, after = simulation.pixels_uv
    moved = np.sqrt((after[:, 0] - before[:, 0]) ** 2 + (after[:, 1] - before[:, 1]) ** 2)
    evaluate = {
        "8": lambda at: column_residual(camera, at, after[:, 0]),
        "9": lambda at: row_residual(camera, at, after[:, 1]),
        "10": lambda at: distance_residual(camera, at, before, moved),
    }[equation]
    residual, gradient = evaluate(points)
    assert residual == pytest.approx(np.zeros(30), abs=1e-9)
    step = 1e-4
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (evaluate(points + shift)[0] - evaluate(points - shift)[0]) / (2 * step)
        assert gradient[:, axis] == pytest.approx(slope, abs=1e-4)


def test_the_start_is_the_parallel_back_projection_at_the_mean_depth(simulate) -> None:  # type: ignore[no-untyped-def]
    camera = simulate("H18", "AP", 1).camera
    moved = np.array([[5.0, 0.0], [0.0, -3.0]])
    displacement = start_displacement(camera, 480.0, moved, np.array([0.0, 2.0]))
    focal = 1000 / (178 / 512)
    assert displacement == pytest.approx(np.array([[5 * 480 / focal, 0, 0], [0, -3 * 480 / focal, 2.0]]))


def test_a_point_that_is_hidden_goes_on_from_where_it_was(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 5)
    visible = np.ones((5, 30), dtype=bool)
    visible[2:4, 4] = False
    pixels = np.where(visible[..., None], simulation.pixels_uv, 0.0)
    whole = track(simulation, 1.0)
    found = track_points(simulation.camera, simulation.points_mm[0], pixels, visible, 0, 1.0)
    assert found[2:4, 4] == pytest.approx(np.broadcast_to(found[1, 4], (2, 3)))
    assert found[4, 4] == pytest.approx(whole[4, 4], abs=0.05)
    assert found[:, 5] == pytest.approx(whole[:, 5])


def test_the_share_of_motion_since_the_start_is_periodic() -> None:
    share = motion_variance_share(np.array([0.8, 0.9, 0.3, 0.8, np.nan]), 0)
    assert share[0] == share[3] == pytest.approx(0, abs=1e-12)
    assert 0 < share[1] < 1 < share[2]
    assert share[4] == 1
    assert motion_variance_share(np.arange(20) / 20, 0).mean() == pytest.approx(1)


def view(simulation, frames: int = 5, a_priori: bool = True, hidden: int | None = None) -> MonoplaneView:  # type: ignore[no-untyped-def]
    labels = [(name, electrode) for name in ("mapping", "reference") for electrode in (1, 2, 3, 4)]
    points = tuple(
        ElectrodePoint(name, electrode, simulation.points_mm[0, k], 0.3 * np.eye(3), None, None, (0.1, 0.1), 90.0)
        for k, (name, electrode) in enumerate(labels)
    )
    observations = []
    for frame in range(frames):
        chains = tuple(
            NamedChain(
                name, (1, 2, 3, 4), simulation.pixels_uv[frame, 4 * k : 4 * k + 4],
                np.broadcast_to(0.25 * np.eye(2), (4, 2, 2)),
            )
            for k, name in enumerate(("mapping", "reference"))
            if not (name == "mapping" and frame == hidden)
        )  # fmt: skip
        observations.append(Observation(frame, frame / 10, chains))
    return MonoplaneView(
        "S01", "a", simulation.camera, DEFAULT_CATALOGUE, np.arange(frames) * 16.7, tuple(observations),
        points if a_priori else (), 0, None, (),
    )  # fmt: skip


def test_a_track_says_that_its_depth_is_assumed_and_how_uncertain_it_is(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 5)
    track = APrioriLM(APrioriLM.Params(isocentre_sd_mm=0)).track(view(simulation, hidden=2), Silent())
    assert track.labels[0] == ("mapping", 1)
    assert not track.located[2, :4].any()
    assert track.located[2, 4:].all()
    assert (track.positions_mm[2, :4] == 0).all()
    assert track.reasons[0] == (Reason.DEPTH_ASSUMED, Reason.TRACK_INTERRUPTED)
    assert track.reasons[4] == (Reason.DEPTH_ASSUMED,)
    axis = simulation.camera.axis_world
    along = np.sqrt(np.einsum("i,nmij,j->nm", axis, track.covariance_mm2, axis))
    # Along the ray the uncertainty grows with the heart's motion, more so for the mapping catheter.
    assert (np.diff(along[[0, 1, 3, 4], 0]) > 0).all()
    assert along[4, 0] > along[4, 4]
    lateral = np.sqrt(track.covariance_mm2[4, 0, 0, 0])
    assert lateral < 0.5
    # Without a start value in depth the answer is the back-projection at the a-priori depth, to first order.
    assert track.positions_mm[4] == pytest.approx(track.baseline_mm[4], abs=0.2)
    depth = simulation.camera.depth_mm(track.baseline_mm[4])
    assert depth == pytest.approx(simulation.camera.depth_mm(simulation.points_mm[0, :8]))


def test_an_isocentre_error_counts_across_the_view(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 5)
    known, unknown = (
        APrioriLM(APrioriLM.Params(isocentre_sd_mm=sd)).track(view(simulation), Silent()).covariance_mm2
        for sd in (0.0, 0.7)
    )
    assert unknown[4, 0] - known[4, 0] == pytest.approx(np.diag([0.49, 0.49, 0.0]), abs=1e-9)


def test_a_start_value_in_depth_widens_the_answer_s_uncertainty(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 5)
    plain = APrioriLM(APrioriLM.Params()).track(view(simulation), Silent())
    stepped = APrioriLM(APrioriLM.Params(depth_step_mm=2)).track(view(simulation), Silent())
    assert stepped.covariance_mm2[4, 0, 2, 2] > plain.covariance_mm2[4, 0, 2, 2] + 60


def test_without_a_biplane_position_it_refuses(simulate) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(Refusal) as refusal:
        APrioriLM(APrioriLM.Params()).track(view(simulate("H18", "AP", 5), a_priori=False), Silent())
    assert refusal.value.reason is Reason.NO_A_PRIORI
