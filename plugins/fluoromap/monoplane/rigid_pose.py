"""All electrodes as one rigid body: one pose a frame from one view."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import BaseModel, Field

from fluoromap.contracts import Array, BoolArray, Context, MonoplaneView, Refusal, Track
from fluoromap.geometry import Camera
from fluoromap.monoplane.observed import (
    ObservedView,
    lateral_covariance_mm2,
    observe,
    outwards,
    turned_covariance_mm2,
)
from fluoromap.reasons import Reason

FEWEST_ELECTRODES = 4
LEAST_BREADTH_MM = 0.2
"""Second singular value of the body's points: below it they lie on one line, whose turn about itself nothing shows."""
_SETTLED = 1e-12


class RigidPose:
    """Monoplane solver ``rigid-pose``: rotation and translation of the whole set of electrodes, frame by frame.

    Right for a rigid phantom. Catheters in a beating heart are not one rigid body: there it refuses, with the figure.
    """

    class Params(BaseModel, extra="forbid"):
        """When to refuse."""

        iterations: int = Field(6, ge=1, le=50, description="Gauss-Newton steps a frame, from the frame before.")
        largest_bound_mm: float = Field(
            5.0, gt=0, le=100, description="Refuse when the error bound of the positions exceeds this, mm."
        )
        largest_misfit: float = Field(
            1.5,
            gt=1,
            le=100,
            description="Refuse when the reprojection error changes over the frames by this many times the pixel noise.",
        )
        depth_step_mm: float = Field(
            0.0,
            ge=-20,
            le=20,
            description="Start value of each frame's displacement along the ray; the answer has none of it.",
        )
        gantry_angle_sd_deg: float = Field(0.5, ge=0, le=10, description="Error of the gantry angles, degrees.")

    name: ClassVar[str] = "rigid-pose"
    version: ClassVar[str] = "1"

    def __init__(self, params: RigidPose.Params) -> None:
        self._params = params

    def follow(self, view: MonoplaneView, context: Context) -> Track:
        """Follow the body of all electrodes with an a-priori position.

        Raises
        ------
        Refusal
            NO_A_PRIORI; DEPTH_UNOBSERVABLE when the electrodes are fewer than four or lie on one line, when they do not
            move as one rigid body, or when the bound says that depth cannot be had.
        """
        p = self._params
        observed = observe(view)
        context.check()
        body = observed.a_priori_mm
        usable = np.array([_spans(body[row]) for row in observed.seen])
        if not usable.any():
            raise Refusal(
                Reason.DEPTH_UNOBSERVABLE,
                "A rigid pose needs at least four electrodes that do not lie on one line; no frame of this view shows them.",
            )
        rotations, centres = follow_body(
            view.camera, body, observed.pixels_uv, observed.seen, view.a_priori_frame, p.depth_step_mm, p.iterations
        )
        context.progress(0.7)
        positions = (body - body.mean(axis=0)) @ np.swapaxes(rotations, 1, 2) + centres[:, None]
        # The shape's own uncertainty reaches the image like noise; what displaces the whole body does not count here.
        shape = np.array([_shape_covariance(view, observed, k) for k in range(len(body))])
        jacobians = view.camera.jacobian(positions)
        expected = observed.covariance_px2 + jacobians @ shape @ np.swapaxes(jacobians, -1, -2)
        self._refuse_if_not_rigid(view.camera, observed, positions, usable)
        covariance = np.array(
            [
                pose_covariance_mm2(view.camera, positions[f], centres[f], expected[f], observed.seen[f])
                if usable[f] else np.zeros((len(body), 3, 3))
                for f in range(len(positions))
            ]
        )  # fmt: skip
        located = observed.seen & usable[:, None]
        bound = float(np.sqrt(np.trace(covariance[located], axis1=-2, axis2=-1).mean()))
        if bound > p.largest_bound_mm:
            raise Refusal(
                Reason.DEPTH_UNOBSERVABLE,
                f"From this view a rigid pose cannot be known better than {bound:.1f} mm (RMS over the electrodes); "
                f"{p.largest_bound_mm:.1f} mm is the limit.",
            )
        return self._track(view, observed, positions, covariance, located)

    def _refuse_if_not_rigid(self, camera: Camera, observed: ObservedView, positions: Array, usable: BoolArray) -> None:
        counted = observed.seen & usable[:, None]
        shown = counted[..., None]
        residual = np.where(shown, camera.project(positions) - observed.pixels_uv, 0.0)
        # A wrong shape leaves the same residual in every frame; only what changes tells that the body bends.
        residual = np.where(shown, residual - residual.sum(axis=0) / np.maximum(shown.sum(axis=0), 1), 0.0)
        squared = np.einsum("nmi,nmij,nmj->nm", residual, np.linalg.inv(observed.covariance_px2), residual)
        freedom = 2 * counted.sum() - 6 * usable.sum() - 2 * counted.any(axis=0).sum()
        if freedom <= 0:
            return
        misfit = float(np.sqrt(squared[counted].sum() / freedom))
        if misfit > self._params.largest_misfit:
            rms = float(np.sqrt((residual[counted] ** 2).sum(axis=1).mean()))
            raise Refusal(
                Reason.DEPTH_UNOBSERVABLE,
                f"The electrodes do not move as one rigid body: the best poses leave {rms:.1f} px, {misfit:.1f} times the "
                "pixel noise. A heart's catheters bend; use another solver.",
            )

    def _track(
        self, view: MonoplaneView, observed: ObservedView, positions: Array, covariance: Array, located: BoolArray
    ) -> Track:
        baseline = view.camera.back_project(observed.pixels_uv, view.camera.depth_mm(observed.a_priori_mm))
        lateral = lateral_covariance_mm2(view.camera.jacobian(positions), observed.covariance_px2)
        turned = turned_covariance_mm2(positions, self._params.gantry_angle_sd_deg)
        # A tiny share of the pixel noise keeps the ellipsoid of a body's turning axis from being flat.
        whole = covariance + turned + 1e-3 * lateral
        shown = located[..., None]
        return Track(
            labels=observed.labels,
            located=located,
            positions_mm=np.where(shown, positions, 0.0),
            baseline_mm=np.where(shown, baseline, 0.0),
            covariance_mm2=np.where(shown[..., None], whole, 0.0),
            pixels_uv=observed.pixels_uv,
            reasons=tuple(() if bool(column.all()) else (Reason.TRACK_INTERRUPTED,) for column in located.T),
        )


def _shape_covariance(view: MonoplaneView, observed: ObservedView, index: int) -> Array:
    point = observed.a_priori[index]
    relative = point.relative_covariance_mm2
    covariance: Array = point.covariance_mm2 if relative is None else relative
    return covariance


def _spans(points_mm: Array) -> bool:
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
        if not _spans(model[shown]):
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
    """Least-squares poses of B images of one body at once, by damped Gauss-Newton with a left-multiplied rotation update.

    A point is ``R A + c``; the update is ``R <- exp([w]x) R``, ``c <- c + t``, solved from 6x6 normal equations.

    Parameters
    ----------
    model_mm : ndarray, shape (m, 3)
        The body's points about its mean.
    pixels_uv : ndarray, shape (B, m, 2)
    rotations, centres : ndarray, shape (B, 3, 3), (B, 3)
        Where to start.
    iterations : int
        At most; it stops when nothing moves.

    Returns
    -------
    rotations, centres : ndarray, shape (B, 3, 3), (B, 3)
    """
    batch = len(pixels_uv)
    damping = np.full(batch, 1e-6)
    turned = model_mm @ np.swapaxes(rotations, 1, 2)
    residual = pixels_uv - camera.project(turned + centres[:, None])
    cost = (residual**2).sum(axis=(1, 2))
    for _ in range(iterations):
        rows = pose_jacobian(camera, turned, centres).reshape(batch, -1, 6)
        normal = np.swapaxes(rows, 1, 2) @ rows
        scale = np.einsum("bii->bi", normal) * damping[:, None]
        normal = normal + scale[:, :, None] * np.eye(6)
        gradient = np.swapaxes(rows, 1, 2) @ residual.reshape(batch, -1, 1)
        step = np.linalg.solve(normal, gradient)[..., 0]
        tried_rotations = rotation_of(step[:, :3]) @ rotations
        tried_centres = centres + step[:, 3:]
        tried_turned = model_mm @ np.swapaxes(tried_rotations, 1, 2)
        tried_residual = pixels_uv - camera.project(tried_turned + tried_centres[:, None])
        tried_cost = (tried_residual**2).sum(axis=(1, 2))
        better = tried_cost <= cost
        one, two = better[:, None], better[:, None, None]
        rotations, centres = np.where(two, tried_rotations, rotations), np.where(one, tried_centres, centres)
        turned, residual = np.where(two, tried_turned, turned), np.where(two, tried_residual, residual)
        cost = np.where(better, tried_cost, cost)
        damping = np.where(better, damping * 0.1, damping * 100)
        if np.abs(step).max() < _SETTLED:
            break
    return rotations, centres


def pose_jacobian(camera: Camera, turned_mm: Array, centres_mm: Array) -> Array:
    """d(u, v)/d(rotation vector, translation) of points R A (B, m, 3) at centres (B, 3): (B, m, 2, 6), px/rad and px/mm."""
    by_translation = camera.jacobian(turned_mm + centres_mm[:, None])
    by_rotation = np.cross(turned_mm[:, :, None], by_translation)
    rows: Array = np.concatenate([by_rotation, by_translation], axis=-1)
    return rows


def pose_covariance_mm2(
    camera: Camera, positions_mm: Array, centre_mm: Array, covariance_px2: Array, seen: BoolArray
) -> Array:
    """Cramer-Rao bound of the positions (m, 3) of a rigid body whose seen points have these pixel covariances: (m, 3, 3)."""
    turned = positions_mm - centre_mm
    rows = pose_jacobian(camera, turned[None], centre_mm[None])[0][seen]
    weight = np.linalg.inv(covariance_px2[seen])
    information = np.einsum("mki,mkl,mlj->ij", rows, weight, rows)
    pose = np.linalg.inv(information)
    x, y, z = turned.T
    zero = np.zeros_like(x)
    # Turning by w moves a point by w x (R A).
    by_rotation = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1), np.stack([y, -x, zero], -1)], -2)
    gain = np.concatenate([by_rotation, np.broadcast_to(np.eye(3), (len(turned), 3, 3))], axis=-1)
    covariance: Array = gain @ pose @ np.swapaxes(gain, 1, 2)
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
