"""Poses of a rigid body in the frames of one view, their derivatives and their Cramer-Rao bound."""

from __future__ import annotations

import numpy as np
from scipy.linalg import rq

from fluoromap.contracts import Array, BoolArray
from fluoromap.geometry import Camera
from fluoromap.monoplane.view_electrodes import outwards

FEWEST_ELECTRODES = 4
LEAST_BREADTH_MM = 0.2
"""Second singular value below which the body's points lie on one line: no image shows a rotation about that line."""
VAGUE_POSE = np.diag([np.pi**-2] * 3 + [1e-8] * 3)
"""Information (6, 6) on a rotation vector and a translation (1/rad^2, 1/mm^2) of a body somewhere in the room: standard
deviations of half a turn and ten metres. It keeps the bound finite where the image shows nothing."""


def determines_pose(points_mm: Array) -> bool:
    """Return True where points (m, 3) determine a pose.

    At least four points that do not lie on one line are needed.
    """
    if len(points_mm) < FEWEST_ELECTRODES:
        return False
    return bool(np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)[1] > LEAST_BREADTH_MM)


def track_body(
    camera: Camera,
    body_mm: Array,
    pixels_uv: Array,
    visible: BoolArray,
    start: int,
    depth_step_mm: float,
    iterations: int,
) -> tuple[Array, Array]:
    """Track a rigid body through n frames, from frame ``start`` to both ends.

    The iteration of each frame starts at the pose of the frame before.

    Parameters
    ----------
    body_mm : ndarray, shape (m, 3)
        World positions at frame ``start``.
    pixels_uv : ndarray, shape (n, m, 2)
    visible : ndarray of bool, shape (n, m)
        A frame that shows too few points keeps the pose of the frame before.
    depth_step_mm : float
        Displacement along the central ray that is added to each start value.

    Returns
    -------
    rotations : ndarray, shape (n, 3, 3)
        Rotations about the body's mean.
    centres : ndarray, shape (n, 3)
        World positions of the body's mean, mm.
    """
    n = len(pixels_uv)
    mean = body_mm.mean(axis=0)
    model = body_mm - mean
    rotations, centres = np.empty((n, 3, 3)), np.empty((n, 3))

    def solve(frame: int, rotation: Array, centre: Array) -> None:
        rotations[frame], centres[frame] = rotation, centre
        shown = visible[frame]
        if not determines_pose(model[shown]):
            return
        points = model[shown] @ rotation.T + centre
        # A start displaced parallel to the image, so that the mean residual is 0.
        off_px = (pixels_uv[frame, shown] - camera.project(points)).mean(axis=0)
        moved = np.linalg.pinv(camera.jacobian(centre)) @ off_px + depth_step_mm * camera.axis_world
        found = solve_poses(
            camera, model[shown], pixels_uv[frame, shown][None], rotation[None], (centre + moved)[None], iterations
        )
        rotations[frame], centres[frame] = found[0][0], found[1][0]

    solve(start, np.eye(3), mean)
    for frame, before in outwards(n, start):
        solve(frame, rotations[before], centres[before])
    return rotations, centres


def solve_poses(
    camera: Camera, model_mm: Array, pixels_uv: Array, rotations: Array, centres: Array, iterations: int
) -> tuple[Array, Array]:
    """Solve the least-squares poses of one body in B images.

    The compiled steps are Levenberg-Marquardt's. A point is ``R A + c``. The update is ``R <- exp([w]x) R``, ``c <- c +
    t``, solved from 6x6 normal equations. The iteration works in the camera's axes. Where these are left-handed, the
    transform into them is a reflection too, so that R stays a rotation.

    Parameters
    ----------
    model_mm : ndarray, shape (m, 3)
        The body's points about its mean.
    pixels_uv : ndarray, shape (B, m, 2)
    rotations, centres : ndarray, shape (B, 3, 3), (B, 3)
        Start of the iteration. A start behind the source is returned unchanged.
    iterations : int
        Largest number of steps; the iteration ends earlier when the cost no longer falls.

    Returns
    -------
    rotations, centres : ndarray, shape (B, 3, 3), (B, 3)
    """
    from fluoromap.monoplane.pose_kernel import solve_batch  # importing numba takes a second

    intrinsic, axes = _intrinsic_and_axes(camera)
    offset = np.linalg.solve(intrinsic, camera.matrix[:, 3])
    turns = np.ascontiguousarray(axes @ rotations)
    placed = np.ascontiguousarray(centres @ axes.T + offset)
    focal = np.array([intrinsic[0, 0], intrinsic[0, 1], intrinsic[1, 1]])
    solve_batch(focal, np.ascontiguousarray(model_mm.T), pixels_uv - intrinsic[:2, 2], turns, placed, iterations)
    return axes.T @ turns, (placed - offset) @ axes


def _intrinsic_and_axes(camera: Camera) -> tuple[Array, Array]:
    """Return a camera's upper triangular matrix (positive diagonal) and orthogonal matrix (determinant +1 or -1)."""
    triangle, orthogonal = rq(camera.matrix[:, :3])
    signs = np.sign(np.diag(triangle))
    intrinsic = np.asarray(triangle * signs, dtype=np.float64)
    axes = np.asarray(signs[:, None] * orthogonal, dtype=np.float64)
    return intrinsic, axes


def pose_jacobian(camera: Camera, turned_mm: Array, centres_mm: Array) -> Array:
    """Return d(u, v)/d(rotation vector, translation), (B, m, 2, 6), px/rad and px/mm.

    ``turned_mm`` (B, m, 3) are the points R A, ``centres_mm`` (B, 3) the body's centres.
    """
    by_translation = camera.jacobian(turned_mm + centres_mm[:, None])
    by_rotation = np.cross(turned_mm[:, :, None], by_translation)
    rows: Array = np.concatenate([by_rotation, by_translation], axis=-1)
    return rows


def point_jacobian(turned_mm: Array) -> Array:
    """Return d(position)/d(rotation vector, translation) of points R A (m, 3): (m, 3, 6), mm/rad and 1."""
    x, y, z = turned_mm.T
    zero = np.zeros_like(x)
    # A rotation by w displaces a point by w x (R A).
    by_rotation = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1), np.stack([y, -x, zero], -1)], -2)
    return np.concatenate([by_rotation, np.broadcast_to(np.eye(3), (len(turned_mm), 3, 3))], axis=-1)


def pose_covariance_mm2(
    camera: Camera, positions_mm: Array, centre_mm: Array, covariance_px2: Array, visible: BoolArray
) -> Array:
    """Return the Cramer-Rao bound (m, 3, 3) of the positions (m, 3) of a rigid body.

    The visible points have the pixel covariances ``covariance_px2`` (m, 2, 2). The bound is always finite: it is some metres
    wide where the image shows nothing.
    """
    turned = positions_mm - centre_mm
    rows = pose_jacobian(camera, turned[None], centre_mm[None])[0][visible]
    weight = np.linalg.inv(covariance_px2[visible])
    information = np.einsum("mki,mkl,mlj->ij", rows, weight, rows)
    gain = point_jacobian(turned)
    covariance: Array = gain @ np.linalg.inv(information + VAGUE_POSE) @ np.swapaxes(gain, 1, 2)
    return covariance


def rotation_of(vectors: Array) -> Array:
    """Return the rotation matrices (B, 3, 3) of rotation vectors (B, 3) in radians, by Rodrigues' formula."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    safe = np.maximum(angles, 1e-12)
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)
    rotations: Array = np.eye(3) + np.sin(safe) / safe * cross + 2 * (np.sin(safe / 2) / safe) ** 2 * (cross @ cross)
    return rotations


def vector_of(rotations: Array) -> Array:
    """Return the rotation vectors (B, 3) in radians, shorter than pi, of rotation matrices (B, 3, 3)."""
    odd = rotations - np.swapaxes(rotations, 1, 2)
    sine = np.stack([odd[:, 2, 1], odd[:, 0, 2], odd[:, 1, 0]], axis=-1) / 2
    length = np.linalg.norm(sine, axis=1)
    angle = np.arctan2(length, (np.trace(rotations, axis1=1, axis2=2) - 1) / 2)
    vectors: Array = sine * np.where(length > 1e-9, angle / np.maximum(length, 1e-9), 1.0)[:, None]
    return vectors
