"""The bundle adjustment against dense least squares, its stated errors, and uncertain points."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from fluoromap.contracts import Array
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.monoplane.body_pose import rotation_of, track_body, vector_of
from fluoromap.monoplane.bundle import AdjustedBody, BodyView, adjust

FRAMES, POINTS, START = 5, 6, 1


def small_view(acceleration_sd: tuple[float, float] | None, seed: int = 5) -> tuple[BodyView, Array]:
    """Return five frames of a C-arm view, and the truth.

    There are six points, one hidden once, with unequal noise.
    """
    rng = np.random.default_rng(seed)
    camera = camera_from_gantry(Gantry(30.0, 15.0, 1000.0, 500.0, (0.35, 0.35), 512, 512))
    body = rng.uniform(-25, 25, (POINTS, 3))
    turns = rotation_of(rng.normal(0, 0.02, (FRAMES, 3)) * (np.arange(FRAMES) != START)[:, None])
    shifts = rng.normal(0, 1, (FRAMES, 3))
    truth = body @ np.swapaxes(turns, 1, 2) + shifts[:, None]
    visible = np.ones((FRAMES, POINTS), dtype=bool)
    visible[3, 2] = False
    root = rng.normal(0, 0.3, (FRAMES, POINTS, 2, 2)) + 0.5 * np.eye(2)
    noise = root @ np.swapaxes(root, -1, -2)
    shape_root = rng.normal(0, 0.2, (POINTS, 3, 3)) + 0.6 * np.eye(3)
    shape = shape_root @ np.swapaxes(shape_root, -1, -2)
    prior = body + (shape_root @ rng.normal(0, 1, (POINTS, 3, 1)))[..., 0]
    pixels = camera.project(truth) + (root @ rng.normal(0, 1, (FRAMES, POINTS, 2, 1)))[..., 0]
    frames = np.array([0, 1, 2, 3, 6])
    view = BodyView(camera, prior, shape, np.eye(3), frames, START, pixels, noise, visible, acceleration_sd)
    return view, truth


def adjusted(view: BodyView) -> AdjustedBody:
    return adjust(view, *track_body(view.camera, view.prior_mm, view.pixels_uv, view.visible, view.start, 0.0, 20))


def dense_residuals(view: BodyView, unknowns: Array) -> Array:
    """Return all minimised residuals as one vector.

    The a-priori frame only shifts, the others turn and shift.
    """
    points, shifts = unknowns[: 3 * POINTS].reshape(-1, 3), unknowns[3 * POINTS : 3 * (POINTS + FRAMES)].reshape(-1, 3)
    turns = np.insert(unknowns[3 * (POINTS + FRAMES) :].reshape(-1, 3), START, 0.0, axis=0)
    rotations = rotation_of(turns)
    positions = points @ np.swapaxes(rotations, 1, 2) + shifts[:, None]
    white = np.linalg.inv(np.linalg.cholesky(view.covariance_px2))
    off = (white @ (view.camera.project(positions) - view.pixels_uv)[..., None])[view.visible]
    from_prior = np.linalg.solve(
        np.linalg.cholesky(view.shape_mm2), (points + view.origin_mm - view.prior_mm)[..., None]
    )
    parts = [off.ravel(), from_prior.ravel(), shifts[START] - view.origin_mm]
    if view.acceleration_sd is not None:
        for k in (1, 2):
            change = vector_of(np.stack([rotations[k + 1] @ rotations[k].T, rotations[k] @ rotations[k - 1].T]))
            parts.append((change[0] - change[1]) / view.acceleration_sd[0])
            parts.append((shifts[k + 1] - 2 * shifts[k] + shifts[k - 1]) / view.acceleration_sd[1])
    return np.concatenate(parts)


def dense_positions(unknowns: Array) -> Array:
    points, shifts = unknowns[: 3 * POINTS].reshape(-1, 3), unknowns[3 * POINTS : 3 * (POINTS + FRAMES)].reshape(-1, 3)
    turns = np.insert(unknowns[3 * (POINTS + FRAMES) :].reshape(-1, 3), START, 0.0, axis=0)
    return points @ np.swapaxes(rotation_of(turns), 1, 2) + shifts[:, None]


@pytest.mark.parametrize("acceleration_sd", [None, (0.005, 0.4)])
def test_positions_and_their_covariance_are_those_of_dense_least_squares(acceleration_sd) -> None:  # type: ignore[no-untyped-def]
    view, _ = small_view(acceleration_sd)
    found = adjusted(view)
    start = np.concatenate(
        [(view.prior_mm - view.origin_mm).ravel(), np.tile(view.origin_mm, FRAMES), np.zeros(3 * (FRAMES - 1))]
    )
    dense = least_squares(
        lambda unknowns: dense_residuals(view, unknowns), start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-12
    )
    # The acceleration is linearised for turns that are small from frame to frame; here they reach 3 degrees.
    assert found.positions_mm == pytest.approx(dense_positions(dense.x), abs=2e-2 if acceleration_sd else 1e-4)
    # Two triples of neighbouring frames without a gap.
    freedom = 2 * (FRAMES * POINTS - 1) - 6 * (FRAMES - 1) + (12 if acceleration_sd else 0)
    assert found.freedom == freedom
    assert found.misfit == pytest.approx(np.sqrt(2 * dense.cost / freedom), rel=1e-4)
    covariance = np.linalg.inv(dense.jac.T @ dense.jac)
    step = 1e-5
    gain = np.stack(
        [
            (dense_positions(dense.x + step * unit) - dense_positions(dense.x - step * unit)) / (2 * step)
            for unit in np.eye(len(dense.x))
        ],
        axis=-1,
    )
    for frame in range(FRAMES):
        expected = np.einsum("mia,ab,njb->minj", gain[frame], covariance, gain[frame])
        assert found.covariance_mm2(frame) == pytest.approx(expected, rel=0.02, abs=2e-3 * np.abs(expected).max())


def test_errors_are_as_large_as_stated() -> None:
    squared, misfits = [], []
    for seed in range(60):
        view, truth = small_view(None, seed)
        found = adjusted(view)
        misfits.append(found.misfit**2)
        error = (found.positions_mm - truth).reshape(FRAMES, -1)
        for frame in range(FRAMES):
            joint = found.covariance_mm2(frame).reshape(3 * POINTS, 3 * POINTS)
            squared.append(error[frame] @ np.linalg.solve(joint, error[frame]) / (3 * POINTS))
    assert np.mean(squared) == pytest.approx(1, abs=0.1)
    assert np.mean(misfits) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    ("helix", "frames", "most_mm"), [("H18", 6, 1.3), ("H18", 15, 1.0), ("H77", 6, 1.2), ("H77", 15, 0.6)]
)
def test_a_priori_errors_of_two_millimetres_shrink(simulate, helix: str, frames: int, most_mm: float) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate(helix, "LAT", frames)
    rng = np.random.default_rng(21)
    squared = []
    for _ in range(8):
        prior = simulation.points_mm[0] + rng.uniform(-2, 2, (30, 3))
        pixels = simulation.pixels_uv + rng.normal(0, 0.5, simulation.pixels_uv.shape)
        found = adjusted(
            BodyView(
                simulation.camera, prior, np.broadcast_to(4 / 3 * np.eye(3), (30, 3, 3)), np.zeros((3, 3)),
                np.arange(frames), 0, pixels, np.broadcast_to(0.25 * np.eye(2), (frames, 30, 2, 2)),
                np.ones((frames, 30), dtype=bool),
            )
        )  # fmt: skip
        squared.append(((found.positions_mm - simulation.points_mm)[1:] ** 2).sum(axis=2).mean())
    # Eight bodies scatter; the benchmark has forty.
    assert np.sqrt(np.mean(squared)) <= 1.1 * most_mm


def test_a_smooth_path_is_tracked_better_when_it_is_known_to_be_smooth(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "LAT", 12)
    rng = np.random.default_rng(22)
    pixels = simulation.pixels_uv + rng.normal(0, 0.5, simulation.pixels_uv.shape)
    error = []
    for acceleration_sd in (None, (0.001, 0.05)):
        found = adjusted(
            BodyView(
                simulation.camera, simulation.points_mm[0], np.zeros((30, 3, 3)), np.zeros((3, 3)), np.arange(12), 0, pixels,
                np.broadcast_to(0.25 * np.eye(2), (12, 30, 2, 2)), np.ones((12, 30), dtype=bool), acceleration_sd,
            )
        )  # fmt: skip
        error.append(np.sqrt(((found.positions_mm - simulation.points_mm) ** 2).sum(axis=2).mean()))
        stated = [np.trace(found.covariance_mm2(f)[k, :, k]) for f in range(12) for k in range(30)]
        assert error[-1] == pytest.approx(np.sqrt(np.mean(stated)), rel=0.5)
    assert error[1] < 0.6 * error[0]
