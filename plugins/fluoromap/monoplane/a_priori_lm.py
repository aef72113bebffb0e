"""The paper's monoplane method: electrode by electrode from an a-priori position, by Levenberg's iteration.

The three equations of each electrode and frame have one null direction, along the ray. The iteration never changes the
start value's component along the ray. The method therefore estimates no depth; every track carries ``depth_assumed``.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import BaseModel, Field

from fluoromap.contracts import Array, BoolArray, Context, MonoplaneView, Track
from fluoromap.geometry import Camera
from fluoromap.monoplane.view_electrodes import (
    ViewElectrodes,
    gantry_angle_covariance_mm2,
    gather_electrodes,
    isocentre_covariance_mm2,
    lateral_covariance_mm2,
    outwards,
)
from fluoromap.reasons import Reason

_ITERATIONS = 60
_DAMPING = 1e-2
_SETTLED_MM = 1e-10
_HARMONICS = np.arange(1, 5)


class APrioriLM:
    """Monoplane solver ``a-priori-lm``: the paper's equations (8), (9), (10), for comparison."""

    class Params(BaseModel, extra="forbid"):
        """Start value of the iteration, and assumptions behind the covariance along the ray."""

        depth_step_mm: float = Field(
            0.0,
            ge=-20,
            le=20,
            description="Start value of each frame's displacement along the ray (the paper's dz), mm.",
        )
        mapping_motion_sd_mm: float = Field(
            2.9, ge=0, le=30, description="Motion of the mapping catheter along the ray since the a-priori frame, mm."
        )
        other_motion_sd_mm: float = Field(
            1.5, ge=0, le=30, description="Motion of the other catheters along the ray since the a-priori frame, mm."
        )
        respiration_head_feet_sd_mm: float = Field(
            4.0, ge=0, le=30, description="Breathing since the a-priori position, along the patient's long axis, mm."
        )
        respiration_other_sd_mm: float = Field(
            1.0, ge=0, le=30, description="Breathing since the a-priori position, along the other two axes, mm."
        )
        gantry_angle_sd_deg: float = Field(0.5, ge=0, le=10, description="Error of the gantry angles, degrees.")
        isocentre_sd_mm: float = Field(0.5, ge=0, le=20, description="Error of the isocentre's place in this view, mm.")

    name: ClassVar[str] = "a-priori-lm"
    version: ClassVar[str] = "2"

    def __init__(self, params: APrioriLM.Params) -> None:
        self._params = params

    def track(self, view: MonoplaneView, context: Context) -> Track:
        """Track every electrode that has an a-priori position.

        Raises
        ------
        Refusal
            NO_A_PRIORI where no electrode has one.
        """
        electrodes = gather_electrodes(view)
        context.check()
        start_mm = electrodes.a_priori_mm
        positions = track_points(
            view.camera,
            start_mm,
            electrodes.pixels_uv,
            electrodes.visible,
            view.a_priori_frame,
            self._params.depth_step_mm,
        )
        context.progress(0.9)
        baseline = view.camera.back_project(electrodes.pixels_uv, view.camera.depth_mm(start_mm))
        covariance = self._covariance(view, electrodes, positions)
        shown = electrodes.visible[..., None]
        reasons = tuple(
            (Reason.DEPTH_ASSUMED, Reason.TRACK_INTERRUPTED) if interrupted else (Reason.DEPTH_ASSUMED,)
            for interrupted in electrodes.interrupted()
        )
        return Track(
            labels=electrodes.labels,
            located=electrodes.visible,
            positions_mm=np.where(shown, positions, 0.0),
            baseline_mm=np.where(shown, baseline, 0.0),
            covariance_mm2=np.where(shown[..., None], covariance, 0.0),
            pixels_uv=electrodes.pixels_uv,
            reasons=reasons,
        )

    def _covariance(self, view: MonoplaneView, electrodes: ViewElectrodes, positions: Array) -> Array:
        """Return the covariance (n, m, 3, 3) of the positions.

        Across the ray it comes from the pixels. Along the ray it comes from the a-priori position, the heart's motion
        since then, breathing and the start value.
        """
        p = self._params
        jacobians = view.camera.jacobian(positions)
        rays = positions - view.camera.source_world_mm
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        a_priori = np.array([point.covariance_mm2 for point in electrodes.a_priori])
        respiration = (
            np.diag([p.respiration_other_sd_mm, p.respiration_other_sd_mm, p.respiration_head_feet_sd_mm]) ** 2
        )
        along = np.einsum("nmi,mij,nmj->nm", rays, a_priori + respiration, rays)
        motion_sd = np.array(
            [
                p.mapping_motion_sd_mm if catheter == view.catalogue.mapping else p.other_motion_sd_mm
                for catheter in electrodes.catheters
            ]
        )
        along = along + motion_sd**2 * motion_variance_share(electrodes.phases, view.a_priori_frame)[:, None]
        away = np.abs(np.arange(len(positions)) - view.a_priori_frame)
        along = along + ((p.depth_step_mm * away) ** 2)[:, None]
        covariance: Array = (
            lateral_covariance_mm2(jacobians, electrodes.covariance_px2)
            + along[..., None, None] * rays[..., :, None] * rays[..., None, :]
            + gantry_angle_covariance_mm2(positions, p.gantry_angle_sd_deg)
            + isocentre_covariance_mm2(view.camera, p.isocentre_sd_mm)
        )
        return covariance


def motion_variance_share(phases: Array, start: int) -> Array:
    """Return the variance (n,) of the displacement since frame ``start``.

    It is a share of its mean over the cycle. The heart's motion is modelled as a random sum of the cycle's first
    harmonics whose amplitudes fall as h^-1.5. The share is ``1 - k`` with ``k`` the motion's correlation at the
    difference of phase. It is 0 at the start and at the same phase of other beats, and largest half a cycle away. It is
    1 where phases are unknown.
    """
    weights = _HARMONICS**-3.0
    apart = phases - phases[start]
    correlation = (np.cos(2 * np.pi * _HARMONICS * apart[:, None]) * weights).sum(axis=1) / weights.sum()
    share: Array = np.where(np.isfinite(apart), 1 - correlation, 1.0)
    share[start] = 0.0
    return share


def track_points(
    camera: Camera, a_priori_mm: Array, pixels_uv: Array, visible: BoolArray, start: int, depth_step_mm: float
) -> Array:
    """Track m points through n frames of one view by equations (8), (9), (10).

    Parameters
    ----------
    a_priori_mm : ndarray, shape (m, 3)
        World positions at frame ``start``.
    pixels_uv : ndarray, shape (n, m, 2)
        Pixels (u, v); ignored where ``visible`` is False.
    visible : ndarray of bool, shape (n, m)
        A hidden point keeps its last position and continues from there in the next frame that shows it.
    start : int
        The a-priori frame; tracking runs from it to both ends.
    depth_step_mm : float
        Start value of the displacement along the central ray for each frame (the paper's dz); negated for frames before
        ``start``.

    Returns
    -------
    ndarray, shape (n, m, 3)
    """
    n, m = pixels_uv.shape[:2]
    mean_depth_mm = float(camera.depth_mm(a_priori_mm).mean())
    positions = np.empty((n, m, 3))
    last_uv = np.empty((n, m, 2))
    waiting = np.zeros((n, m))
    last_uv[start] = np.where(visible[start][:, None], pixels_uv[start], camera.project(a_priori_mm))
    positions[start] = levenberg(camera, a_priori_mm, last_uv[start], last_uv[start])
    for frame, before in outwards(n, start):
        shown = visible[frame][:, None]
        last_uv[frame] = np.where(shown, pixels_uv[frame], last_uv[before])
        frames_gone = waiting[before] + 1
        waiting[frame] = np.where(visible[frame], 0, frames_gone)
        depth_steps = np.sign(frame - before) * depth_step_mm * frames_gone
        displacement = start_displacement(camera, mean_depth_mm, last_uv[frame] - last_uv[before], depth_steps)
        found = levenberg(camera, positions[before] + displacement, last_uv[frame], last_uv[before])
        positions[frame] = np.where(shown, found, positions[before])
    return positions


def start_displacement(camera: Camera, mean_depth_mm: float, moved_px: Array, depth_steps_mm: Array) -> Array:
    """Return the start value of displacements (m, 3), mm.

    The pixel displacements (m, 2) are scaled back to the mean depth, du Zavg / f; a step in depth (m,) is added.
    """
    principal = camera.principal_point_uv
    across = camera.matrix[:2, :3] - principal[:, None] * camera.matrix[2, :3]
    lateral = moved_px @ np.linalg.pinv(across).T * mean_depth_mm
    displacement: Array = lateral + depth_steps_mm[:, None] * camera.axis_world
    return displacement


def column_residual(camera: Camera, points_mm: Array, u: Array) -> tuple[Array, Array]:
    """Return residual (m,) and gradient (m, 3) of eq. (8) of the paper, px and px/mm.

    The residual is (m1 X + m2 Y + m3 Z + m4) / (m9 X + m10 Y + m11 Z + m12) - u.
    """
    return camera.project(points_mm)[:, 0] - u, camera.jacobian(points_mm)[:, 0]


def row_residual(camera: Camera, points_mm: Array, v: Array) -> tuple[Array, Array]:
    """Return residual (m,) and gradient (m, 3) of eq. (9) of the paper, px and px/mm.

    The residual is (m5 X + m6 Y + m7 Z + m8) / (m9 X + m10 Y + m11 Z + m12) - v.
    """
    return camera.project(points_mm)[:, 1] - v, camera.jacobian(points_mm)[:, 1]


def distance_residual(camera: Camera, points_mm: Array, before_uv: Array, distance_px: Array) -> tuple[Array, Array]:
    """Return residual (m,) and gradient (m, 3) of eq. (10) of the paper, px and px/mm.

    The residual is the length of the projected displacement minus d = sqrt(du^2 + dv^2). The paper prints d^2 for d. Its
    model side is read as the perspective image displacement from the point's pixel in the frame before: only this reading
    reproduces the paper's Table 1.
    """
    moved = camera.project(points_mm) - before_uv
    length = np.linalg.norm(moved, axis=1)
    direction = moved / np.maximum(length, 1e-12)[:, None]
    return length - distance_px, np.einsum("mk,mki->mi", direction, camera.jacobian(points_mm))


def levenberg(camera: Camera, start_mm: Array, pixels_uv: Array, before_uv: Array) -> Array:
    """Solve (8), (9), (10) for each point separately.

    The damping is lambda I in mm; Marquardt's scaling does not reproduce the paper.

    Parameters
    ----------
    start_mm : ndarray, shape (m, 3)
        Start of the iteration; its component along the ray stays unchanged.
    pixels_uv, before_uv : ndarray, shape (m, 2)
        Pixels of the points in this frame and the frame before.

    Returns
    -------
    ndarray, shape (m, 3)
    """
    distance_px = np.linalg.norm(pixels_uv - before_uv, axis=1)

    def equations(points: Array) -> tuple[Array, Array]:
        rows = (
            column_residual(camera, points, pixels_uv[:, 0]),
            row_residual(camera, points, pixels_uv[:, 1]),
            distance_residual(camera, points, before_uv, distance_px),
        )
        return np.stack([residual for residual, _ in rows], axis=1), np.stack(
            [gradient for _, gradient in rows], axis=1
        )

    points = start_mm.copy()
    damping = np.full(len(points), _DAMPING)
    residual, jacobian = equations(points)
    for _ in range(_ITERATIONS):
        normal = np.einsum("mki,mkj->mij", jacobian, jacobian) + damping[:, None, None] * np.eye(3)
        step = -np.linalg.solve(normal, np.einsum("mki,mk->mi", jacobian, residual)[..., None])[..., 0]
        trial, trial_jacobian = equations(points + step)
        better = (trial**2).sum(axis=1) < (residual**2).sum(axis=1)
        points = np.where(better[:, None], points + step, points)
        residual = np.where(better[:, None], trial, residual)
        jacobian = np.where(better[:, None, None], trial_jacobian, jacobian)
        damping = np.clip(np.where(better, damping * 0.1, damping * 10), 1e-12, 1e12)
        if len(step) == 0 or np.abs(step).max() < _SETTLED_MM:
            break
    return points
