"""The pose of a rigid body in one view against truth, the Cramer-Rao bound and finite differences, in either handedness."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.monoplane.body_pose import (
    determines_pose,
    point_jacobian,
    pose_covariance_mm2,
    pose_jacobian,
    rotation_of,
    solve_poses,
    track_body,
    vector_of,
)

VECTORS = st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_rotation_of_a_vector_is_the_matrix_exponential(vector: list[float]) -> None:
    x, y, z = vector
    generator = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    assert rotation_of(np.array([vector]))[0] == pytest.approx(expm(generator), abs=1e-12)


@given(VECTORS)
def test_vector_of_undoes_rotation_of(vector: list[float]) -> None:
    assert vector_of(rotation_of(np.array([vector])))[0] == pytest.approx(vector, abs=1e-9)


def cloud(seed: int, points: int = 12, radius_mm: float = 30.0):  # type: ignore[no-untyped-def]
    return np.random.default_rng(seed).uniform(-radius_mm, radius_mm, (points, 3))


def c_arm(primary_deg: float = 37.0, secondary_deg: float = -20.0) -> Camera:
    """Return a view of a C-arm: left-handed, oblique, pixels that are not square."""
    return camera_from_gantry(Gantry(primary_deg, secondary_deg, 1040.0, 530.0, (0.35, 0.31), 512, 640))


def test_derivatives_are_those_of_finite_differences() -> None:
    camera, turned, centre = c_arm(), cloud(1), np.array([4.0, -7, 2])
    step = 1e-5
    for k in range(6):
        change = np.zeros(6)
        change[k] = step
        moved = [turned @ rotation_of(sign * change[None, :3])[0].T + centre + sign * change[3:] for sign in (1, -1)]
        by_pixels = (camera.project(moved[0]) - camera.project(moved[1])) / (2 * step)
        assert pose_jacobian(camera, turned[None], centre[None])[0, ..., k] == pytest.approx(by_pixels, abs=1e-5)
        assert point_jacobian(turned)[..., k] == pytest.approx((moved[0] - moved[1]) / (2 * step), abs=1e-6)


def body_positions(simulation, rotations, centres):  # type: ignore[no-untyped-def]
    body = simulation.points_mm[0]
    return (body - body.mean(axis=0)) @ np.swapaxes(rotations, 1, 2) + centres[:, None]


@pytest.mark.parametrize("view", ["AP", "LAT"])
@pytest.mark.parametrize("helix", ["H18", "H77"])
@pytest.mark.parametrize("frames", [3, 30])
def test_without_noise_every_start_in_depth_gives_the_truth(simulate, helix: str, view: str, frames: int) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate(helix, view, frames)
    visible = np.ones(simulation.pixels_uv.shape[:2], dtype=bool)
    for depth_step_mm in range(6):
        poses = track_body(
            simulation.camera, simulation.points_mm[0], simulation.pixels_uv, visible, 0, float(depth_step_mm), 6
        )
        assert np.abs(body_positions(simulation, *poses) - simulation.points_mm).max() <= 1e-8


@given(VECTORS, st.integers(0, 1000), st.booleans())
def test_in_either_handedness_a_pose_is_a_rotation_and_the_truth(
    vector: list[float], seed: int, mirrored: bool
) -> None:
    camera = c_arm()
    if mirrored:
        flip = np.array([[-1.0, 0, camera.columns - 1], [0, 1, 0], [0, 0, 1]])
        camera = Camera(flip @ camera.matrix, camera.rows, camera.columns)
    assert np.sign(np.linalg.det(camera.matrix[:, :3])) == (1 if mirrored else -1)
    body, rotation, centre = cloud(seed), rotation_of(np.array([vector]) * 0.4), np.array([[3.0, 5, -8]])
    truth = body @ rotation[0].T + centre
    rotations, centres = solve_poses(camera, body, camera.project(truth)[None], np.eye(3)[None], np.zeros((1, 3)), 50)
    assert np.linalg.det(rotations[0]) == pytest.approx(1, abs=1e-9)
    assert rotations == pytest.approx(rotation, abs=1e-9)
    assert centres == pytest.approx(centre, abs=1e-7)


def test_under_noise_the_pose_is_where_the_gradient_vanishes() -> None:
    camera, body = c_arm(), cloud(2)
    rng = np.random.default_rng(3)
    pixels = camera.project(body + np.array([1.0, 2, 3])) + rng.normal(0, 0.5, (50, 12, 2))
    start = np.broadcast_to(np.eye(3), (50, 3, 3)), np.zeros((50, 3))
    rotations, centres = solve_poses(camera, body, pixels, *start, 10)
    turned = body @ np.swapaxes(rotations, 1, 2)
    residual = (pixels - camera.project(turned + centres[:, None])).reshape(50, -1, 1)
    rows = pose_jacobian(camera, turned, centres).reshape(50, -1, 6)
    gradient = np.swapaxes(rows, 1, 2) @ residual
    step = np.linalg.solve(np.swapaxes(rows, 1, 2) @ rows, gradient)[..., 0]
    assert np.abs(step).max() < 1e-5
    assert (start[1] == 0).all()


def test_an_image_of_its_own_does_not_move_the_others() -> None:
    camera, body = c_arm(), cloud(4)
    pixels = camera.project(body + np.array([[[1.0, 0, 0]], [[0, 2, 0]], [[0, 0, 3]]]))
    together = solve_poses(camera, body, pixels, np.broadcast_to(np.eye(3), (3, 3, 3)), np.zeros((3, 3)), 10)
    for k in range(3):
        alone = solve_poses(camera, body, pixels[k : k + 1], np.eye(3)[None], np.zeros((1, 3)), 10)
        assert alone[0][0] == pytest.approx(together[0][k], abs=1e-12)
        assert alone[1][0] == pytest.approx(together[1][k], abs=1e-10)


def test_a_start_behind_the_source_stays_and_no_solution_lies_there() -> None:
    camera, body = c_arm(), cloud(5)
    behind = (camera.source_world_mm - 100 * camera.axis_world)[None]
    rotations, centres = solve_poses(camera, body, camera.project(body)[None], np.eye(3)[None], behind, 10)
    assert rotations[0] == pytest.approx(np.eye(3), abs=1e-12)
    assert centres == pytest.approx(behind, abs=1e-9)
    wild = np.random.default_rng(6).uniform(0, 500, (200, 12, 2))
    rotations, centres = solve_poses(
        camera, body, wild, np.broadcast_to(np.eye(3), (200, 3, 3)), np.zeros((200, 3)), 30
    )
    placed = body @ np.swapaxes(rotations, 1, 2) + centres[:, None]
    assert np.isfinite(placed).all()
    assert camera.depth_mm(placed).min() > 0


@pytest.mark.parametrize(("helix", "view"), [("H18", "AP"), ("H18", "LAT"), ("H77", "AP"), ("H77", "LAT")])
@pytest.mark.parametrize("noise_px", [0.25, 1.0])
def test_under_noise_it_reaches_the_cramer_rao_bound(simulate, helix: str, view: str, noise_px: float) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate(helix, view, 2)
    rng = np.random.default_rng(11)
    batch = 10_000
    truth = simulation.points_mm[1]
    body = simulation.points_mm[0]
    pixels = simulation.pixels_uv[1] + rng.normal(0, noise_px, (batch, 30, 2))
    start = np.broadcast_to(np.eye(3), (batch, 3, 3)), np.broadcast_to(body.mean(axis=0), (batch, 3))
    found = body_positions(simulation, *solve_poses(simulation.camera, body - body.mean(axis=0), pixels, *start, 5))
    rms = np.sqrt(((found - truth) ** 2).sum(axis=2).mean())
    covariance = pose_covariance_mm2(
        simulation.camera, truth, truth.mean(axis=0),
        np.broadcast_to(noise_px**2 * np.eye(2), (30, 2, 2)), np.ones(30, dtype=bool),
    )  # fmt: skip
    bound = np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean())
    assert 0.97 <= rms / bound <= 1.03


@pytest.mark.parametrize(("helix", "most_mm"), [("H18", 0.42), ("H77", 0.11)])
def test_the_error_stays_at_the_bound_through_thirty_frames(simulate, helix: str, most_mm: float) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate(helix, "LAT", 30)
    rng = np.random.default_rng(12)
    body = simulation.points_mm[0] - simulation.points_mm[0].mean(axis=0)
    noise, visible = np.broadcast_to(0.25 * np.eye(2), (30, 2, 2)), np.ones(30, dtype=bool)
    rotations = np.broadcast_to(np.eye(3), (1000, 3, 3))
    centres = np.broadcast_to(simulation.points_mm[0].mean(axis=0), (1000, 3))
    squared = []
    for at, exact in zip(simulation.points_mm[1:], simulation.pixels_uv[1:], strict=True):
        pixels = exact + rng.normal(0, 0.5, (1000, 30, 2))
        rotations, centres = solve_poses(simulation.camera, body, pixels, rotations, centres, 6)
        squared.append(((body @ np.swapaxes(rotations, 1, 2) + centres[:, None] - at) ** 2).sum(axis=2).mean())
        covariance = pose_covariance_mm2(simulation.camera, at, at.mean(axis=0), noise, visible)
        # Of 1000 poses, whose error is one number, the depth: it scatters by 2 %.
        assert np.sqrt(squared[-1] / np.trace(covariance, axis1=1, axis2=2).mean()) == pytest.approx(1, abs=0.09)
    assert np.sqrt(np.mean(squared)) <= most_mm


def test_the_bound_without_an_image_is_wide_and_finite() -> None:
    camera, body = c_arm(), cloud(7)
    noise = np.broadcast_to(0.25 * np.eye(2), (12, 2, 2))
    one = np.arange(12) == 3
    covariance = pose_covariance_mm2(camera, body, body[3], noise, one)
    assert np.isfinite(covariance).all()
    assert np.sqrt(covariance[3].trace()) > 1000
    line = np.arange(12)[:, None] * np.array([3.0, 1, 2])
    assert np.isfinite(pose_covariance_mm2(camera, line, line.mean(axis=0), noise, np.ones(12, dtype=bool))).all()


@pytest.mark.parametrize(
    ("points", "enough"),
    [(cloud(1, 3), False), (cloud(1, 4), True), (np.arange(9)[:, None] * np.array([3.0, 1, 2]), False)],
)
def test_four_points_off_one_line_are_enough(points, enough: bool) -> None:  # type: ignore[no-untyped-def]
    assert determines_pose(points) is enough
