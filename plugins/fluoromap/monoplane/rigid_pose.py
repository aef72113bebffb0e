"""All electrodes as one rigid body: one pose a frame from one view."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, Field
from scipy.special import gammaincc

from fluoromap.contracts import Array, Context, IntArray, MonoplaneView, Refusal, Track
from fluoromap.monoplane.body_pose import follow_body, pose_covariance_mm2, solve_poses, spans
from fluoromap.monoplane.bundle import AdjustedBody, BodyView, adjust
from fluoromap.monoplane.observed_view import ObservedView, isocentre_covariance_mm2, observe, turned_covariance_mm2
from fluoromap.monoplane.rigidity import rigid_error_mm, tells_of_body
from fluoromap.reasons import Reason

__all__ = ["RigidPose", "follow_body", "pose_covariance_mm2", "solve_poses"]

_CHANCE = 0.01
_NO_BOUND_MM = 500.0


class RigidPose:
    """Monoplane solver ``rigid-pose``: rotation and translation of the whole set of electrodes, frame by frame.

    Right for a rigid phantom. Catheters in a beating heart are not one rigid body, and one catheter is too small a body to
    tell its depth: there it refuses, with the figure. A body that contracts and one that moves away look alike from one view,
    so it also refuses where neither the user nor cycles seen in two views say that the body keeps its shape.
    """

    class Params(BaseModel, extra="forbid"):
        """When to refuse, and what is known of the body's motion."""

        known_rigid: bool = Field(
            False,
            description="The electrodes are one rigid body, a phantom's for example. Otherwise two views of the study must have "
            "shown that they nearly are; what two views have shown to bend is refused all the same.",
        )
        iterations: int = Field(6, ge=1, le=50, description="Steps of the pose a frame, from the frame before.")
        largest_bound_mm: float = Field(
            5.0,
            gt=0,
            le=100,
            description="Largest error bound (RMS) of a frame's positions, and error of a rigid pose over a known cycle, mm.",
        )
        largest_misfit: float = Field(
            1.2,
            gt=1,
            le=100,
            description="Refuse when the best rigid body misses the electrodes by this many times the pixel noise. A heart's "
            "contraction looks like depth: what is left over at 1.5 goes with ten millimetres.",
        )
        depth_step_mm: float = Field(
            0.0,
            ge=-20,
            le=20,
            description="Start value of each frame's displacement along the ray; the answer has none of it.",
        )
        gantry_angle_sd_deg: float = Field(0.5, ge=0, le=10, description="Error of the gantry angles, degrees.")
        isocentre_sd_mm: float = Field(0.5, ge=0, le=20, description="Error of the isocentre's place in this view, mm.")
        acceleration_sd_mm: float | None = Field(
            None,
            gt=0,
            le=100,
            description="For a body on a smooth path: by how much its displacement from frame to frame changes, mm, one "
            "standard deviation; its turn changes by as much at 50 mm from its middle. Empty: every frame for itself.",
        )

    name: ClassVar[str] = "rigid-pose"
    version: ClassVar[str] = "3"

    def __init__(self, params: RigidPose.Params) -> None:
        self._params = params

    def track(self, view: MonoplaneView, context: Context) -> Track:
        """Follow the body of all electrodes with an a-priori position, which is refined within its covariance.

        Raises
        ------
        Refusal
            NO_A_PRIORI; DEPTH_UNOBSERVABLE when no frame shows four electrodes off one line, when they do not move as one
            rigid body, when the Cramer-Rao bound says that their depth cannot be had, or when nothing tells that they keep
            their shape; VIEW_MIRRORED when they would be a rigid body if the image were mirrored.
        """
        observed = observe(view)
        context.check()
        usable = np.array([spans(observed.a_priori_mm[row]) for row in observed.seen])
        if not usable.any():
            raise _too_few(view, observed)
        shown_rigid = self._shown_rigid(view, observed)
        usable[view.a_priori_frame] = True
        frames = np.flatnonzero(usable)
        body = self._fit(view, observed, frames)
        context.progress(0.7)
        context.check()
        if body.misfit > self._params.largest_misfit:
            raise self._not_rigid(view, observed, frames, body)
        track = self._track(view, observed, frames, body)
        if not (shown_rigid or self._params.known_rigid):
            raise _shape_unknown(view, observed)
        return track

    def _shown_rigid(self, view: MonoplaneView, observed: ObservedView) -> bool:
        """Whether cycles seen in two views tell that a rigid pose is good enough; refuses when they tell that it is not."""
        cycles = view.others if view.cycle is None else (view.cycle,)
        whole = [cycle for cycle in cycles if tells_of_body(cycle, observed.labels)]
        told = [rigid_error_mm(view.camera, cycle, observed.labels) for cycle in whole or cycles]
        errors = [error for error in told if error is not None]
        if errors and (error := float(np.median(errors))) > self._params.largest_bound_mm:
            raise Refusal(
                Reason.DEPTH_UNOBSERVABLE,
                f"The electrodes do not move as one rigid body: over the cycle known from two views a rigid pose would be "
                f"{error:.1f} mm wrong (RMS over the electrodes); {self._params.largest_bound_mm:.1f} mm is the limit. A "
                "heart's catheters move by themselves; use another solver.",
            )
        return bool(whole and errors)

    def _fit(self, view: MonoplaneView, observed: ObservedView, frames: IntArray) -> AdjustedBody:
        p = self._params
        poses = follow_body(
            view.camera,
            observed.a_priori_mm,
            observed.pixels_uv,
            observed.seen,
            view.a_priori_frame,
            p.depth_step_mm,
            p.iterations,
        )
        shape, displacement = _prior_covariances(observed)
        smooth = p.acceleration_sd_mm
        body = BodyView(
            camera=view.camera,
            prior_mm=observed.a_priori_mm,
            shape_mm2=shape,
            displacement_mm2=displacement,
            frames=frames,
            start=int(np.searchsorted(frames, view.a_priori_frame)),
            pixels_uv=observed.pixels_uv[frames],
            covariance_px2=observed.covariance_px2[frames],
            seen=observed.seen[frames],
            acceleration_sd=None if smooth is None else (smooth / 50.0, smooth),
        )
        return adjust(body, poses[0][frames], poses[1][frames])

    def _not_rigid(self, view: MonoplaneView, observed: ObservedView, frames: IntArray, body: AdjustedBody) -> Refusal:
        last = np.array([view.camera.columns - 1.0, view.camera.rows - 1.0])
        for axis, sides in enumerate(("left to right", "top to bottom")):
            pixels = observed.pixels_uv.copy()
            pixels[..., axis] = last[axis] - pixels[..., axis]
            if self._fit(view, replace(observed, pixels_uv=pixels), frames).misfit <= self._params.largest_misfit:
                return Refusal(
                    Reason.VIEW_MIRRORED,
                    f"The electrodes fit their positions from two views only when this image is mirrored {sides}; check the "
                    "image orientation of the run.",
                )
        counted = observed.seen[frames]
        off_px = (view.camera.project(body.positions_mm) - observed.pixels_uv[frames])[counted]
        return Refusal(
            Reason.DEPTH_UNOBSERVABLE,
            f"The electrodes do not move as one rigid body: the best poses leave {_rms(off_px):.1f} px, {body.misfit:.1f} "
            "times what the pixel noise explains, and a bend of a tenth of a millimetre passes for millimetres of depth. A "
            "heart's catheters bend; use another solver.",
        )

    def _track(self, view: MonoplaneView, observed: ObservedView, frames: IntArray, body: AdjustedBody) -> Track:
        n, m = observed.seen.shape
        located = observed.seen.copy()
        located[np.setdiff1d(np.arange(n), frames)] = False
        positions = np.zeros((n, m, 3))
        positions[frames] = body.positions_mm
        covariance, relative = np.zeros((2, n, m, 3, 3))
        of_reference = np.array([catheter == view.catalogue.reference for catheter in observed.catheters])
        # A misfit beyond chance means noise or priors larger than stated: what they make of the positions grows alike.
        grown = body.misfit**2 if gammaincc(body.freedom / 2, body.freedom * body.misfit**2 / 2) < _CHANCE else 1.0
        turn_sd_deg = self._params.gantry_angle_sd_deg
        bounds = np.zeros(n)
        for index, frame in enumerate(frames):
            joint = grown * body.covariance_mm2(index)
            covariance[frame] = _of_each(joint)
            bounds[frame] = np.sqrt(np.trace(covariance[frame], axis1=1, axis2=2).mean())
            if of_reference.any():
                # Where the reference catheter is hidden the body tells where it is.
                shown = of_reference & located[frame]
                origin = shown if shown.any() else of_reference
                apart = positions[frame] - positions[frame, origin].mean(axis=0)
                joint = joint - joint[origin].mean(axis=0)
                joint = joint - joint[:, :, origin].mean(axis=2)[:, :, None]
                relative[frame] = _of_each(joint) + turned_covariance_mm2(apart, turn_sd_deg)
        covariance[frames] += turned_covariance_mm2(positions[frames], turn_sd_deg)
        covariance[frames] += isocentre_covariance_mm2(view.camera, self._params.isocentre_sd_mm)
        vague = bounds > self._params.largest_bound_mm
        followed = np.setdiff1d(frames, [view.a_priori_frame])
        if len(followed) and vague[followed].all():
            raise Refusal(
                Reason.DEPTH_UNOBSERVABLE,
                f"From this view a rigid pose cannot be known better than {_rms(bounds[followed, None]):.1f} mm (RMS over "
                f"the electrodes); {self._params.largest_bound_mm:.1f} mm is the limit.",
            )
        reasons: list[list[Reason]] = [[] for _ in range(m)]
        for electrode in np.flatnonzero((located & vague[:, None]).any(axis=0)):
            reasons[electrode].append(Reason.DEPTH_UNOBSERVABLE)
        located[vague] = False
        for electrode in np.flatnonzero(~located.all(axis=0)):
            reasons[electrode].append(Reason.TRACK_INTERRUPTED)
        baseline = view.camera.back_project(observed.pixels_uv, view.camera.depth_mm(observed.a_priori_mm))
        shown = located[..., None]
        return Track(
            labels=observed.labels,
            located=located,
            positions_mm=np.where(shown, positions, 0.0),
            baseline_mm=np.where(shown, baseline, 0.0),
            covariance_mm2=np.where(shown[..., None], covariance, 0.0),
            pixels_uv=observed.pixels_uv,
            reasons=tuple(tuple(codes) for codes in reasons),
            relative_covariance_mm2=np.where(shown[..., None], relative, 0.0) if of_reference.any() else None,
        )


def _too_few(view: MonoplaneView, observed: ObservedView) -> Refusal:
    """The refusal, with the bound of the frame that shows most."""
    best = int(observed.seen.sum(axis=1).argmax())
    body, shown = observed.a_priori_mm, observed.seen[best]
    bound = np.inf
    if shown.any():
        covariance = pose_covariance_mm2(
            view.camera, body, body[shown].mean(axis=0), observed.covariance_px2[best], shown
        )
        bound = float(np.sqrt(np.trace(covariance[shown], axis1=1, axis2=2).mean()))
    told = f"better than {bound:.0f} mm" if bound < _NO_BOUND_MM else "at all"
    return Refusal(
        Reason.DEPTH_UNOBSERVABLE,
        "A rigid pose needs at least four electrodes that do not lie on one line; no frame of this view shows them. From what "
        f"it shows, {int(shown.sum())} electrodes, their positions cannot be known {told}.",
    )


def _shape_unknown(view: MonoplaneView, observed: ObservedView) -> Refusal:
    one_percent_mm = 0.01 * float(view.camera.depth_mm(observed.a_priori_mm).mean())
    return Refusal(
        Reason.DEPTH_UNOBSERVABLE,
        "Nothing tells that these electrodes keep their distances: in one view a heart that contracts by one percent looks like "
        f"one that moves {one_percent_mm:.0f} mm away, and no whole cycle of all these electrodes was seen in two views. Say that "
        "they are one rigid body (known_rigid), as in a phantom, or use another solver.",
    )


def _prior_covariances(observed: ObservedView) -> tuple[Array, Array]:
    """Of the body's points: (m, 3, 3) of each, and (3, 3) of what displaces all of them.

    Relative to the reference catheter a point has the error of the body's shape; what its error from the isocentre has
    beyond that, breathing above all, is shared.
    """
    absolute = np.array([point.covariance_mm2 for point in observed.a_priori])
    known = [point.relative_covariance_mm2 for point in observed.a_priori]
    shape = np.array([whole if part is None else part for whole, part in zip(absolute, known, strict=True)])
    values, axes = np.linalg.eigh((absolute - shape).mean(axis=0))
    return shape, (axes * np.maximum(values, 0)) @ axes.T


def _of_each(joint_mm2: Array) -> Array:
    """Covariances (m, 3, 3) of the points in a joint one (m, 3, m, 3)."""
    each = np.arange(len(joint_mm2))
    blocks: Array = joint_mm2[each, :, each, :]
    return blocks


def _rms(values: Array) -> float:
    """Root of the mean squared length of vectors (k, d)."""
    return float(np.sqrt((values**2).sum(axis=1).mean()))
