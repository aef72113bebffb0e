"""Bundle adjustment of a rigid body's uncertain points and its poses in one view.

The unknowns are the body's m points in the a-priori frame, each with a prior, and one pose a frame. In the normal equations
each frame couples to the points, and under the acceleration prior to its two neighbours on either side. The poses thus form
a band, which is eliminated first. A (3 m, 3 m) system of the points remains (Schur's complement).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.geometry import Camera
from fluoromap.monoplane.body_pose import VAGUE_POSE, point_jacobian, pose_jacobian, rotation_of, vector_of

_STEPS = 30
_CONVERGED = 1e-9
_FIXED_RAD = 1e-6
"""Standard deviation of the rotation in the a-priori frame, which is the identity by definition of the points."""
_FIXED_MM2 = 1e-8
"""Smallest variance of a prior, so that it can be inverted."""


@dataclass(frozen=True, eq=False)
class BodyView:
    """A rigid body of m points in n frames of one view: pixels and priors.

    prior_mm : (m, 3) world positions in frame ``start``. shape_mm2 : (m, 3, 3), their covariance, independent between points.
    displacement_mm2 : (3, 3), covariance of a displacement that all points share.
    frames : (n,), ascending frame numbers of the run. start : index into ``frames`` of the frame of the priors.
    pixels_uv : (n, m, 2). covariance_px2 : (n, m, 2, 2). visible : (n, m), True where the frame shows the point.
    acceleration_sd : standard deviations of the change, from frame to frame, of the pose's rotation (rad) and translation
    (mm); None where they are unknown.
    """

    camera: Camera
    prior_mm: Array
    shape_mm2: Array
    displacement_mm2: Array
    frames: IntArray
    start: int
    pixels_uv: Array
    covariance_px2: Array
    visible: BoolArray
    acceleration_sd: tuple[float, float] | None = None

    @property
    def origin_mm(self) -> Array:
        """Centre of the body's rotation, (3,), world."""
        origin: Array = self.prior_mm.mean(axis=0)
        return origin


@dataclass(frozen=True, eq=False)
class AdjustedBody:
    """The most probable points and poses, and the terms of their joint covariance.

    turned_mm : (n, m, 3), the points about the body's origin, rotated in each frame. rotations : (n, 3, 3).
    centres_mm : (n, 3), world positions of the origin. points_covariance_mm2 : (3 m, 3 m). pose_covariance : (n, 6, 6) for
    known points. coupling : (n, 6, 3 m), change of the pose (rotation vector, translation) with an error of the points.
    misfit : root of the cost over its degrees of freedom ``freedom``; 1 where noise and priors are as stated.
    """

    turned_mm: Array
    rotations: Array
    centres_mm: Array
    points_covariance_mm2: Array
    pose_covariance: Array
    coupling: Array
    misfit: float
    freedom: int

    @property
    def positions_mm(self) -> Array:
        """World positions (n, m, 3)."""
        return self.turned_mm + self.centres_mm[:, None]

    def covariance_mm2(self, frame: int) -> Array:
        """Return the joint covariance (m, 3, m, 3) of all positions in one of the n frames.

        It is the Cramer-Rao bound with the priors included.
        """
        m = self.turned_mm.shape[1]
        of_pose = point_jacobian(self.turned_mm[frame]).reshape(3 * m, 6)
        of_points = np.kron(np.eye(m), self.rotations[frame]) - of_pose @ self.coupling[frame]
        joint = of_pose @ self.pose_covariance[frame] @ of_pose.T + of_points @ self.points_covariance_mm2 @ of_points.T
        covariance: Array = joint.reshape(m, 3, m, 3)
        return covariance


@dataclass(frozen=True, eq=False)
class _State:
    points: Array
    rotations: Array
    centres: Array


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations: poses (n, 6, 6) with the band of their neighbours, points (m, 3, 3), their coupling (6 n, 3 m)."""

    cost: float
    poses: Array
    points: Array
    coupling: Array
    of_poses: Array
    of_points: Array


def adjust(view: BodyView, rotations: Array, centres_mm: Array) -> AdjustedBody:
    """Find the maximum a-posteriori points and poses by Levenberg-Marquardt.

    Parameters
    ----------
    rotations, centres_mm : ndarray, shape (n, 3, 3), (n, 3)
        Start poses about the prior's mean. The pose of the a-priori frame is ignored: it is known.
    """
    start_rotations, start_centres = rotations.copy(), centres_mm.copy()
    start_rotations[view.start], start_centres[view.start] = np.eye(3), view.origin_mm
    state = _State(view.prior_mm - view.origin_mm, start_rotations, start_centres)
    neighbours = (
        _second_differences(view.frames) if view.acceleration_sd is not None else np.zeros((0, len(centres_mm)))
    )
    information = np.asarray(np.linalg.inv(view.covariance_px2) * view.visible[..., None, None], dtype=np.float64)
    normal = _linearise(view, information, neighbours, state)
    damping = 1e-6
    for _ in range(_STEPS):
        band, reduced = _eliminate(view, normal, neighbours, damping)
        by_poses = cho_solve_banded(band, np.column_stack([normal.coupling, normal.of_poses]))
        of_points = cho_solve(cho_factor(reduced), normal.of_points - normal.coupling.T @ by_poses[:, -1])
        of_poses = by_poses[:, -1] - by_poses[:, :-1] @ of_points
        moved = of_poses.reshape(-1, 6)
        trial = _State(
            state.points + of_points.reshape(-1, 3),
            rotation_of(moved[:, :3]) @ state.rotations,
            state.centres + moved[:, 3:],
        )
        trial_normal = _linearise(view, information, neighbours, trial)
        gained = normal.cost - trial_normal.cost
        if gained >= 0:
            state, normal = trial, trial_normal
            damping *= 0.1
        else:
            damping *= 100
        if abs(gained) <= _CONVERGED * normal.cost:
            break
    return _adjusted_body(view, normal, neighbours, state)


def _second_differences(frames: IntArray) -> Array:
    """Return the matrix (triples, n) with a row 1 -2 1 for each three consecutive frames."""
    middle = [k for k in range(1, len(frames) - 1) if frames[k + 1] - frames[k - 1] == 2]
    rows = np.zeros((len(middle), len(frames)))
    for row, k in zip(rows, middle, strict=True):
        row[k - 1 : k + 2] = 1, -2, 1
    return rows


def _linearise(view: BodyView, information: Array, neighbours: Array, state: _State) -> _Normal:
    n, m = view.visible.shape
    turned = state.points @ np.swapaxes(state.rotations, 1, 2)
    positions = turned + state.centres[:, None]
    residual = np.where(view.visible[..., None], view.pixels_uv - view.camera.project(positions), 0.0)
    by_pose = pose_jacobian(view.camera, turned, state.centres)
    by_point = view.camera.jacobian(positions) @ state.rotations[:, None]
    weighted = information @ residual[..., None]
    pose_weighted, point_weighted = np.swapaxes(by_pose, -1, -2) @ information, np.swapaxes(by_point, -1, -2)
    cost = float((residual[..., None] * weighted).sum())
    if view.camera.depth_mm(positions).min() <= 0:
        cost = np.inf
    poses = (pose_weighted @ by_pose).sum(axis=1) + VAGUE_POSE
    coupling = np.swapaxes(pose_weighted @ by_point, 1, 2).reshape(6 * n, 3 * m)
    of_poses = (np.swapaxes(by_pose, -1, -2) @ weighted)[..., 0].sum(axis=1)

    prior_information = np.linalg.inv(view.shape_mm2 + _FIXED_MM2 * np.eye(3))
    off_prior = view.prior_mm - view.origin_mm - state.points
    pulled = (prior_information @ off_prior[..., None])[..., 0]
    cost += float((off_prior * pulled).sum())
    points = (point_weighted @ information @ by_point).sum(axis=0) + prior_information
    of_points = (point_weighted @ weighted)[..., 0].sum(axis=0) + pulled

    fixed = _start_information(view.displacement_mm2)
    off_start = -np.concatenate(
        [vector_of(state.rotations[view.start][None])[0], state.centres[view.start] - view.origin_mm]
    )
    cost += float(off_start @ fixed @ off_start)
    poses[view.start] += fixed
    of_poses[view.start] += fixed @ off_start

    if view.acceleration_sd is not None:
        turns = np.zeros((n, 3))
        turns[1:] = np.cumsum(vector_of(state.rotations[1:] @ np.swapaxes(state.rotations[:-1], 1, 2)), axis=0)
        curving = neighbours @ np.concatenate([turns, state.centres], axis=1)
        stiffness = _stiffness(view.acceleration_sd)
        cost += float((curving**2 * stiffness).sum())
        of_poses -= neighbours.T @ (curving * stiffness)
    return _Normal(cost, poses, points, coupling, of_poses.ravel(), of_points.ravel())


def _start_information(displacement_mm2: Array) -> Array:
    information = np.eye(6) / _FIXED_RAD**2
    information[3:, 3:] = np.linalg.inv(displacement_mm2 + _FIXED_MM2 * np.eye(3))
    return information


def _stiffness(acceleration_sd: tuple[float, float]) -> Array:
    return np.repeat(np.asarray(acceleration_sd) ** -2.0, 3)


def _eliminate(view: BodyView, normal: _Normal, neighbours: Array, damping: float) -> tuple[tuple[Array, bool], Array]:
    """Return the Cholesky factor of the poses' band, and the points' (3 m, 3 m) equations without the poses."""
    n, m = view.visible.shape
    poses = normal.poses * (1 + damping * np.eye(6))
    reach = 18 if view.acceleration_sd is not None else 6
    band = np.zeros((reach, 6 * n))
    for row in range(6):
        for column in range(row + 1):
            band[row - column, column::6] = poses[:, row, column]
    if view.acceleration_sd is not None:
        gram = neighbours.T @ neighbours
        for apart in range(min(3, n)):
            couples = np.diagonal(gram, apart)[:, None] * _stiffness(view.acceleration_sd)
            band[6 * apart, : 6 * (n - apart)] += couples.ravel()
    factor = (cholesky_banded(band, lower=True), True)
    reduced = -normal.coupling.T @ cho_solve_banded(factor, normal.coupling)
    blocks = reduced.reshape(m, 3, m, 3)
    blocks[np.arange(m), :, np.arange(m), :] += normal.points * (1 + damping * np.eye(3))
    return factor, reduced


def _adjusted_body(view: BodyView, normal: _Normal, neighbours: Array, state: _State) -> AdjustedBody:
    n, m = view.visible.shape
    band, reduced = _eliminate(view, normal, neighbours, 0.0)
    pose_covariance = np.empty((n, 6, 6))
    for frame in range(n):
        own = slice(6 * frame, 6 * frame + 6)
        unit = np.zeros((6 * n, 6))
        unit[own] = np.eye(6)
        pose_covariance[frame] = cho_solve_banded(band, unit)[own]
    # The priors measure the points and the a-priori displacement, so that these cost no degree of freedom.
    freedom = 2 * int(view.visible.sum()) - 6 * (n - 1) + 6 * len(neighbours)
    return AdjustedBody(
        turned_mm=state.points @ np.swapaxes(state.rotations, 1, 2),
        rotations=state.rotations,
        centres_mm=state.centres,
        points_covariance_mm2=np.asarray(np.linalg.inv(reduced), dtype=np.float64),
        pose_covariance=pose_covariance,
        coupling=cho_solve_banded(band, normal.coupling).reshape(n, 6, 3 * m),
        misfit=float(np.sqrt(normal.cost / freedom)) if freedom > 0 else 1.0,
        freedom=freedom,
    )
