"""Rigid-body tracking: all electrodes as one body with one pose a frame, from one view."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, Field
from scipy.special import gammaincc

from fluoromap.contracts import Array, Context, IntArray, MonoplaneView, Refusal, Track
from fluoromap.monoplane.body_pose import determines_pose, pose_covariance_mm2, track_body
from fluoromap.monoplane.bundle import AdjustedBody, BodyView, adjust
from fluoromap.monoplane.rigidity import covers_body, rigid_error_mm
from fluoromap.monoplane.view_electrodes import (
    ViewElectrodes,
    gantry_angle_covariance_mm2,
    gather_electrodes,
    isocentre_covariance_mm2,
)
from fluoromap.reasons import Reason

_CHANCE = 0.01
_NO_BOUND_MM = 500.0


class RigidPose:
    """Monoplane solver ``rigid-pose``: rotation and translation of the whole set of electrodes, frame by frame.

    The solver suits a rigid phantom. It refuses, with the figure, in these cases:

    - Catheters in a beating heart: they are not one rigid body.
    - One catheter alone: it is too small a body to show its depth.
    - Neither the user nor cycles from two views confirm that the body keeps its shape. A body that contracts and a body
      that moves away look alike in one view.
    """

    class Params(BaseModel, extra="forbid"):
        """Limits of refusal, and assumptions about the body's motion."""

        known_rigid: bool = Field(
            False,
            description="The electrodes are one rigid body, for example of a phantom. Without this, two views of the study "
            "must show that they nearly are. A body that bends in two views is refused in either case.",
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
            "contraction looks like depth: a misfit of 1.5 comes with an error of ten millimetres.",
        )
        depth_step_mm: float = Field(
            0.0,
            ge=-20,
            le=20,
            description="Start value of each frame's displacement along the ray; the result does not depend on it.",
        )
        gantry_angle_sd_deg: float = Field(0.5, ge=0, le=10, description="Error of the gantry angles, degrees.")
        isocentre_sd_mm: float = Field(0.5, ge=0, le=20, description="Error of the isocentre's place in this view, mm.")
        acceleration_sd_mm: float | None = Field(
            None,
            gt=0,
            le=100,
            description="For a body on a smooth path: change of its displacement from frame to frame, mm, one standard "
            "deviation; its rotation changes by as much at 50 mm from its middle. Empty: frames are independent.",
        )

    name: ClassVar[str] = "rigid-pose"
    version: ClassVar[str] = "3"

    def __init__(self, params: RigidPose.Params) -> None:
        self._params = params

    def track(self, view: MonoplaneView, context: Context) -> Track:
        """Track the body of all electrodes with an a-priori position.

        Its shape is refined within its covariance.

        Raises
        ------
        Refusal
            - NO_A_PRIORI where no electrode has an a-priori position.
            - DEPTH_UNOBSERVABLE where no frame shows four electrodes off one line, where they do not move as one rigid
              body, where the Cramer-Rao bound of their depth is too large, or where no data confirm that they keep their
              shape.
            - VIEW_MIRRORED where they would be a rigid body in the mirrored image.
        """
        electrodes = gather_electrodes(view)
        context.check()
        usable = np.array([determines_pose(electrodes.a_priori_mm[row]) for row in electrodes.visible])
        if not usable.any():
            raise _too_few(view, electrodes)
        shown_rigid = self._shown_rigid(view, electrodes)
        usable[view.a_priori_frame] = True
        frames = np.flatnonzero(usable)
        body = self._fit(view, electrodes, frames)
        context.progress(0.7)
        context.check()
        if body.misfit > self._params.largest_misfit:
            raise self._not_rigid(view, electrodes, frames, body)
        track = self._track(view, electrodes, frames, body)
        if not (shown_rigid or self._params.known_rigid):
            raise _shape_unknown(view, electrodes)
        return track

    def _shown_rigid(self, view: MonoplaneView, electrodes: ViewElectrodes) -> bool:
        """Return True where cycles from two views confirm a rigid body.

        Raise Refusal where they contradict one.
        """
        cycles = view.others if view.cycle is None else (view.cycle,)
        whole = [cycle for cycle in cycles if covers_body(cycle, electrodes.labels)]
        known = [rigid_error_mm(view.camera, cycle, electrodes.labels) for cycle in whole or cycles]
        errors = [error for error in known if error is not None]
        if errors and (error := float(np.median(errors))) > self._params.largest_bound_mm:
            raise Refusal(
                Reason.DEPTH_UNOBSERVABLE,
                f"The electrodes do not move as one rigid body: over the cycle known from two views a rigid pose would be "
                f"{error:.1f} mm wrong (RMS over the electrodes); the limit is {self._params.largest_bound_mm:.1f} mm. "
                "Catheters in a heart move independently. Use another solver.",
            )
        return bool(whole and errors)

    def _fit(self, view: MonoplaneView, electrodes: ViewElectrodes, frames: IntArray) -> AdjustedBody:
        p = self._params
        poses = track_body(
            view.camera,
            electrodes.a_priori_mm,
            electrodes.pixels_uv,
            electrodes.visible,
            view.a_priori_frame,
            p.depth_step_mm,
            p.iterations,
        )
        shape, displacement = _prior_covariances(electrodes)
        smooth = p.acceleration_sd_mm
        body = BodyView(
            camera=view.camera,
            prior_mm=electrodes.a_priori_mm,
            shape_mm2=shape,
            displacement_mm2=displacement,
            frames=frames,
            start=int(np.searchsorted(frames, view.a_priori_frame)),
            pixels_uv=electrodes.pixels_uv[frames],
            covariance_px2=electrodes.covariance_px2[frames],
            visible=electrodes.visible[frames],
            acceleration_sd=None if smooth is None else (smooth / 50.0, smooth),
        )
        return adjust(body, poses[0][frames], poses[1][frames])

    def _not_rigid(
        self, view: MonoplaneView, electrodes: ViewElectrodes, frames: IntArray, body: AdjustedBody
    ) -> Refusal:
        last = np.array([view.camera.columns - 1.0, view.camera.rows - 1.0])
        for axis, sides in enumerate(("left to right", "top to bottom")):
            pixels = electrodes.pixels_uv.copy()
            pixels[..., axis] = last[axis] - pixels[..., axis]
            if self._fit(view, replace(electrodes, pixels_uv=pixels), frames).misfit <= self._params.largest_misfit:
                return Refusal(
                    Reason.VIEW_MIRRORED,
                    f"The electrodes agree with their biplane positions only when this image is mirrored {sides}; check the "
                    "image orientation of the run.",
                )
        counted = electrodes.visible[frames]
        off_px = (view.camera.project(body.positions_mm) - electrodes.pixels_uv[frames])[counted]
        return Refusal(
            Reason.DEPTH_UNOBSERVABLE,
            f"The electrodes do not move as one rigid body: the best poses leave {_rms(off_px):.1f} px, {body.misfit:.1f} "
            "times the pixel noise. A bend of a tenth of a millimetre looks like millimetres of depth. Catheters in a heart "
            "bend. Use another solver.",
        )

    def _track(self, view: MonoplaneView, electrodes: ViewElectrodes, frames: IntArray, body: AdjustedBody) -> Track:
        n, m = electrodes.visible.shape
        located = electrodes.visible.copy()
        located[np.setdiff1d(np.arange(n), frames)] = False
        positions = np.zeros((n, m, 3))
        positions[frames] = body.positions_mm
        covariance, relative = np.zeros((2, n, m, 3, 3))
        of_reference = np.array([catheter == view.catalogue.reference for catheter in electrodes.catheters])
        # A misfit beyond chance means that noise or priors are larger than stated; the covariances grow in proportion.
        grown = body.misfit**2 if gammaincc(body.freedom / 2, body.freedom * body.misfit**2 / 2) < _CHANCE else 1.0
        turn_sd_deg = self._params.gantry_angle_sd_deg
        bounds = np.zeros(n)
        for index, frame in enumerate(frames):
            joint = grown * body.covariance_mm2(index)
            covariance[frame] = _of_each(joint)
            bounds[frame] = np.sqrt(np.trace(covariance[frame], axis1=1, axis2=2).mean())
            if of_reference.any():
                # The body also gives the position of a hidden reference catheter.
                shown = of_reference & located[frame]
                origin = shown if shown.any() else of_reference
                apart = positions[frame] - positions[frame, origin].mean(axis=0)
                joint = joint - joint[origin].mean(axis=0)
                joint = joint - joint[:, :, origin].mean(axis=2)[:, :, None]
                relative[frame] = _of_each(joint) + gantry_angle_covariance_mm2(apart, turn_sd_deg)
        covariance[frames] += gantry_angle_covariance_mm2(positions[frames], turn_sd_deg)
        covariance[frames] += isocentre_covariance_mm2(view.camera, self._params.isocentre_sd_mm)
        vague = bounds > self._params.largest_bound_mm
        other_frames = np.setdiff1d(frames, [view.a_priori_frame])
        if len(other_frames) and vague[other_frames].all():
            raise Refusal(
                Reason.DEPTH_UNOBSERVABLE,
                f"This view cannot determine a rigid pose better than {_rms(bounds[other_frames, None]):.1f} mm (RMS over the "
                f"electrodes); the limit is {self._params.largest_bound_mm:.1f} mm. Use another solver.",
            )
        reasons: list[list[Reason]] = [[] for _ in range(m)]
        for electrode in np.flatnonzero((located & vague[:, None]).any(axis=0)):
            reasons[electrode].append(Reason.DEPTH_UNOBSERVABLE)
        located[vague] = False
        for electrode in np.flatnonzero(~located.all(axis=0)):
            reasons[electrode].append(Reason.TRACK_INTERRUPTED)
        baseline = view.camera.back_project(electrodes.pixels_uv, view.camera.depth_mm(electrodes.a_priori_mm))
        shown = located[..., None]
        return Track(
            labels=electrodes.labels,
            located=located,
            positions_mm=np.where(shown, positions, 0.0),
            baseline_mm=np.where(shown, baseline, 0.0),
            covariance_mm2=np.where(shown[..., None], covariance, 0.0),
            pixels_uv=electrodes.pixels_uv,
            reasons=tuple(tuple(codes) for codes in reasons),
            relative_covariance_mm2=np.where(shown[..., None], relative, 0.0) if of_reference.any() else None,
        )


def _too_few(view: MonoplaneView, electrodes: ViewElectrodes) -> Refusal:
    """Return the refusal of too few electrodes.

    It names the bound of the frame that shows most.
    """
    best = int(electrodes.visible.sum(axis=1).argmax())
    body, shown = electrodes.a_priori_mm, electrodes.visible[best]
    bound = np.inf
    if shown.any():
        covariance = pose_covariance_mm2(
            view.camera, body, body[shown].mean(axis=0), electrodes.covariance_px2[best], shown
        )
        bound = float(np.sqrt(np.trace(covariance[shown], axis1=1, axis2=2).mean()))
    accuracy = f"better than {bound:.0f} mm" if bound < _NO_BOUND_MM else "at all"
    return Refusal(
        Reason.DEPTH_UNOBSERVABLE,
        "A rigid pose needs at least four electrodes that do not lie on one line; no frame of this view shows them. The best "
        f"frame shows {int(shown.sum())} electrodes; their positions cannot be known {accuracy}. Use another solver.",
    )


def _shape_unknown(view: MonoplaneView, electrodes: ViewElectrodes) -> Refusal:
    one_percent_mm = 0.01 * float(view.camera.depth_mm(electrodes.a_priori_mm).mean())
    return Refusal(
        Reason.DEPTH_UNOBSERVABLE,
        "No data confirm that these electrodes keep their distances: two views show no whole cycle of all of them. In one view a "
        f"heart that contracts by one percent looks like a heart that moves {one_percent_mm:.0f} mm away. Set known_rigid where "
        "the electrodes are one rigid body, as in a phantom, or use another solver.",
    )


def _prior_covariances(electrodes: ViewElectrodes) -> tuple[Array, Array]:
    """Return the prior covariances of the body.

    (m, 3, 3) of each point, (3, 3) of a displacement of all points. The error of a point relative to the reference
    catheter is the error of the body's shape. The rest of its error from the isocentre, mainly breathing, is common to
    all points.
    """
    absolute = np.array([point.covariance_mm2 for point in electrodes.a_priori])
    known = [point.relative_covariance_mm2 for point in electrodes.a_priori]
    shape = np.array([whole if part is None else part for whole, part in zip(absolute, known, strict=True)])
    values, axes = np.linalg.eigh((absolute - shape).mean(axis=0))
    return shape, (axes * np.maximum(values, 0)) @ axes.T


def _of_each(joint_mm2: Array) -> Array:
    """Return the covariances (m, 3, 3) of single points from the joint covariance (m, 3, m, 3)."""
    each = np.arange(len(joint_mm2))
    blocks: Array = joint_mm2[each, :, each, :]
    return blocks


def _rms(values: Array) -> float:
    """Return the root of the mean squared length of vectors (k, d)."""
    return float(np.sqrt((values**2).sum(axis=1).mean()))
