"""A rigid body seen in one view: its pose in every frame, the derivatives, and the bound of what a view can tell."""

from __future__ import annotations

import numpy as np
from scipy.linalg import rq

from fluoromap.contracts import Array, BoolArray
from fluoromap.geometry import Camera
from fluoromap.monoplane.observed_view import outwards

FEWEST_ELECTRODES = 4
LEAST_BREADTH_MM = 0.2
"""Second singular value of the body's points: below it they lie on one line, whose turn about itself nothing shows."""
VAGUE_POSE = np.diag([np.pi**-2] * 3 + [1e-8] * 3)
"""Information (6, 6) on a rotation vector and a translation (1/rad^2, 1/mm^2) by someone who knows no more than the room:
half a turn, ten metres. It keeps the bound of what no image tells a number."""


def spans(points_mm: Array) -> bool:
    """Whether points (m, 3) are enough for a pose: four that do not lie on one line."""
    if len(points_mm) < FEWEST_ELECTRODES:
        return False
    return bool(np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)[1] > LEAST_BREADTH_MM)


def follow_body(
    camera: Camera,
    body_mm: Array,
    pixels_uv: Array,
    seen: BoolArray,
    start: int,
    depth_step_mm: float,
    iterations: int,
) -> tuple[Array, Array]:
    """Poses of a rigid body through n frames, from frame ``start`` to both ends, each from the pose before.

    Parameters
    ----------
    body_mm : ndarray, shape (m, 3)
        World positions at frame ``start``.
    pixels_uv : ndarray, shape (n, m, 2)
    seen : ndarray of bool, shape (n, m)
        A frame that shows too few points keeps the pose before it.
    depth_step_mm : float
        Added to each start along the central ray.

    Returns
    -------
    rotations : ndarray, shape (n, 3, 3)
        About the body's mean.
    centres : ndarray, shape (n, 3)
        Where the mean is.
    """
    n = len(pixels_uv)
    mean = body_mm.mean(axis=0)
    model = body_mm - mean
    rotations, centres = np.empty((n, 3, 3)), np.empty((n, 3))

    def solve(frame: int, rotation: Array, centre: Array) -> None:
        rotations[frame], centres[frame] = rotation, centre
        shown = seen[frame]
        if not spans(model[shown]):
            return
        points = model[shown] @ rotation.T + centre
        # Start: displaced in parallel to the image so that the points lie right on average.
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
    """Least-squares poses of B images of one body at once, by compiled Levenberg-Marquardt steps.

    A point is ``R A + c``; the update is ``R <- exp([w]x) R``, ``c <- c + t``, solved from 6x6 normal equations. It works in
    the camera's axes; where those are left-handed, as seen from the detector, so is the turn into them, and R stays a rotation.

    Parameters
    ----------
    model_mm : ndarray, shape (m, 3)
        The body's points about its mean.
    pixels_uv : ndarray, shape (B, m, 2)
    rotations, centres : ndarray, shape (B, 3, 3), (B, 3)
        Where to start. A start behind the source is returned as it is.
    iterations : int
        At most; it stops when nothing is to be gained.

    Returns
    -------
    rotations, centres : ndarray, shape (B, 3, 3), (B, 3)
    """
    from fluoromap.monoplane.pose_kernel import solve_batch  # numba loads only where a pose is wanted

    intrinsic, axes = _intrinsic_and_axes(camera)
    offset = np.linalg.solve(intrinsic, camera.matrix[:, 3])
    turns = np.ascontiguousarray(axes @ rotations)
    placed = np.ascontiguousarray(centres @ axes.T + offset)
    focal = np.array([intrinsic[0, 0], intrinsic[0, 1], intrinsic[1, 1]])
    solve_batch(focal, np.ascontiguousarray(model_mm.T), pixels_uv - intrinsic[:2, 2], turns, placed, iterations)
    return axes.T @ turns, (placed - offset) @ axes


def _intrinsic_and_axes(camera: Camera) -> tuple[Array, Array]:
    """Upper triangular matrix with a positive diagonal and orthogonal matrix, of determinant +1 or -1, of a camera."""
    triangle, orthogonal = rq(camera.matrix[:, :3])
    signs = np.sign(np.diag(triangle))
    intrinsic = np.asarray(triangle * signs, dtype=np.float64)
    axes = np.asarray(signs[:, None] * orthogonal, dtype=np.float64)
    return intrinsic, axes


def pose_jacobian(camera: Camera, turned_mm: Array, centres_mm: Array) -> Array:
    """d(u, v)/d(rotation vector, translation) of points R A (B, m, 3) at centres (B, 3): (B, m, 2, 6), px/rad and px/mm."""
    by_translation = camera.jacobian(turned_mm + centres_mm[:, None])
    by_rotation = np.cross(turned_mm[:, :, None], by_translation)
    rows: Array = np.concatenate([by_rotation, by_translation], axis=-1)
    return rows


def point_jacobian(turned_mm: Array) -> Array:
    """d(position)/d(rotation vector, translation) of points R A (m, 3): (m, 3, 6), mm/rad and 1."""
    x, y, z = turned_mm.T
    zero = np.zeros_like(x)
    # Turning by w moves a point by w x (R A).
    by_rotation = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1), np.stack([y, -x, zero], -1)], -2)
    return np.concatenate([by_rotation, np.broadcast_to(np.eye(3), (len(turned_mm), 3, 3))], axis=-1)


def pose_covariance_mm2(
    camera: Camera, positions_mm: Array, centre_mm: Array, covariance_px2: Array, seen: BoolArray
) -> Array:
    """Cramer-Rao bound of the positions (m, 3) of a rigid body whose seen points have these pixel covariances: (m, 3, 3).

    Always finite: where the image tells nothing it is some metres wide.
    """
    turned = positions_mm - centre_mm
    rows = pose_jacobian(camera, turned[None], centre_mm[None])[0][seen]
    weight = np.linalg.inv(covariance_px2[seen])
    information = np.einsum("mki,mkl,mlj->ij", rows, weight, rows)
    gain = point_jacobian(turned)
    covariance: Array = gain @ np.linalg.inv(information + VAGUE_POSE) @ np.swapaxes(gain, 1, 2)
    return covariance


def rotation_of(vectors: Array) -> Array:
    """Rotation matrices (B, 3, 3) of rotation vectors (B, 3) in radians, by Rodrigues' formula."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    safe = np.maximum(angles, 1e-12)
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)
    rotations: Array = np.eye(3) + np.sin(safe) / safe * cross + 2 * (np.sin(safe / 2) / safe) ** 2 * (cross @ cross)
    return rotations


def vector_of(rotations: Array) -> Array:
    """Rotation vectors (B, 3) in radians, shorter than pi, of rotation matrices (B, 3, 3)."""
    odd = rotations - np.swapaxes(rotations, 1, 2)
    sine = np.stack([odd[:, 2, 1], odd[:, 0, 2], odd[:, 1, 0]], axis=-1) / 2
    length = np.linalg.norm(sine, axis=1)
    angle = np.arctan2(length, (np.trace(rotations, axis1=1, axis2=2) - 1) / 2)
    vectors: Array = sine * np.where(length > 1e-9, angle / np.maximum(length, 1e-9), 1.0)[:, None]
    return vectors
