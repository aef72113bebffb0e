"""Depth over the cardiac cycle: expected motion, refined by the pixels of one view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np
from pydantic import Field

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, BoolArray, Context, MonoplaneView, Refusal, StudyShares, Track
from fluoromap.monoplane.catheter_lengths import catheter_lengths
from fluoromap.monoplane.expected_motion import expected_motion
from fluoromap.monoplane.gaussian_path import Evidence, PathPrior, estimate_gains, most_probable, surprise, whiten
from fluoromap.monoplane.motion_covariance import BEND, FIXED, OFFSET, OTHER, TILT, MotionCovariance, MotionParams
from fluoromap.monoplane.view_electrodes import (
    ViewElectrodes,
    gantry_angle_covariance_mm2,
    gather_electrodes,
    lateral_covariance_mm2,
)
from fluoromap.reasons import Reason

_STEPS = 5
_GAINS = ((1.0, 2.0, 4.0), (0.25, 1.0, 4.0, 16.0, 64.0), (0.25, 1.0, 4.0, 16.0, 64.0))
"""Choices of the gain of offset, tilt and bend. An offset's gain is never below 1: agreement of the view with the cycle across
its rays does not make the depth more certain."""
_LOOSER, _LOOSENINGS = 8.0, 3
_LONGEST_WINDOW = 64
_IRREGULAR = 0.15
_MIRRORED_SHARE = 0.5


class MotionPrior:
    """Monoplane solver ``motion-prior``.

    One view shows no depth; two views showed it at other times. The expected path of each electrode comes from the first
    source that is known:

    - the site's own biplane cycle at the frame's phase,
    - the diastolic point, displaced as the other sites' cycles,
    - the diastolic point.

    The result is the most probable path, given the pixels, the catheters' lengths, and the variation of beats, breathing
    and catheters. The view itself determines how loosely a catheter keeps its shape. The baseline is the plain
    back-projection at the expected depth. It replaces the path where view and expectation disagree.
    """

    class Params(MotionParams):
        """Variation of hearts, and limits beyond which the view is not believed."""

        gate_sd: float = Field(
            2.5, gt=0, le=10, description="A catheter's depth is not moved by more than this many standard deviations."
        )
        surprise_sd: float = Field(
            5.0,
            gt=0,
            le=50,
            description="A catheter farther than this from its expected place in a frame is not used there.",
        )

    name: ClassVar[str] = "motion-prior"
    version: ClassVar[str] = "7"

    def __init__(self, params: MotionPrior.Params) -> None:
        self._params = params.with_any_gantry()

    def track(self, view: MonoplaneView, context: Context) -> Track:
        """Track every electrode that has an a-priori position.

        Raises
        ------
        Refusal
            NO_A_PRIORI where no electrode has one; VIEW_MIRRORED where the view fits the cycle only as a mirror image.
        """
        electrodes = gather_electrodes(view)
        p = self._params
        expected = expected_motion(
            view, electrodes, p.mapping_motion_sd_mm, p.other_motion_sd_mm, p.beat_sd_mm, p.gantry_angle_sd_deg
        )
        covariance = MotionCovariance(view, electrodes.labels, expected, electrodes.phases, p)
        baseline = view.camera.back_project(electrodes.pixels_uv, view.camera.depth_mm(expected.mean_mm))
        baseline = np.where(electrodes.visible[..., None], baseline, expected.mean_mm)
        windows = tuple(_windows(electrodes.phases))
        run = _Run(view, electrodes, baseline, covariance.rays, expected.mean_mm, expected.common_mm2)
        n, m = electrodes.visible.shape
        positions, joint = baseline.copy(), np.zeros((n, 3 * m, 3 * m))
        depth = np.zeros((OTHER, n, m, m))
        trusted, gated = np.zeros((2, n, m), dtype=np.bool_)
        for number, frames in enumerate(windows):
            context.check()
            prior = covariance.window(frames)
            trusted[frames] = self._near(run, frames, prior)
            positions[frames], joint[frames], depth[:, frames], closed = self._window(
                run, frames, prior, trusted[frames]
            )
            gated[frames] = (closed | ~trusted[frames]) & electrodes.visible[frames]
            context.progress((number + 1) / len(windows))
        self._refuse_mirrored(run, trusted, windows, covariance)
        reasons = list(expected.reasons)
        if expected.cycle_spread > _IRREGULAR:
            reasons.append(Reason.IRREGULAR_RHYTHM)
        return self._track(run, positions, joint, depth, gated, reasons)

    def _near(self, run: _Run, frames: slice, prior: PathPrior) -> BoolArray:
        """Return the pixels (n, m) that are near enough to the prior's expectation to be used."""
        electrodes = run.electrodes
        found = _by_catheter(electrodes, run.surprise(frames, prior), frames)
        near: BoolArray = electrodes.visible[frames] & (found <= self._params.surprise_sd)
        return near

    def _refuse_mirrored(
        self, run: _Run, trusted: BoolArray, windows: tuple[slice, ...], covariance: MotionCovariance
    ) -> None:
        """Refuse a view that only its mirror image explains.

        Most pixels are too far from the expectation, and would not be in the mirrored image.

        Raises
        ------
        Refusal
            VIEW_MIRRORED.
        """
        if trusted.sum() >= _MIRRORED_SHARE * run.electrodes.visible.sum():
            return
        mirrored = run.mirrored()
        near = sum(self._near(mirrored, frames, covariance.window(frames)).sum() for frames in windows)
        if near > 2 * trusted.sum():
            raise Refusal(
                Reason.VIEW_MIRRORED,
                "This view agrees with the biplane positions only as a mirror image; check its image orientation.",
            )

    def _window(
        self, run: _Run, frames: slice, prior: PathPrior, trusted: BoolArray
    ) -> tuple[Array, Array, Array, BoolArray]:
        """Return the answer for one window.

        Returns
        -------
        tuple
            Positions (n, m, 3), joint covariance (n, 3 m, 3 m), joint covariance of the depths from each cause that the study
            scales (4, n, m, m), and gated catheters (n, m).
        """
        evidence = run.evidence(frames, trusted)
        start, rays = run.baseline_mm[frames], run.rays[frames]
        free = bool((prior.parts != FIXED).any())
        at_start = whiten(prior, evidence, start)
        gains = estimate_gains(prior, at_start, _GAINS) if free else np.ones(4)
        for attempt in range(1 + _LOOSENINGS):
            paths = most_probable(prior, evidence, gains, start, at_start, _STEPS)
            apart = paths.positions_mm - start
            usual = prior.variance_mm2(gains, (FIXED, OFFSET), rays)
            closed = self._gated_catheters(run.electrodes, evidence.used, np.einsum("nmi,nmi->nm", apart, rays), usual)
            if not free or not closed.any() or attempt == _LOOSENINGS:
                break
            gains[[TILT, BEND]] *= _LOOSER
        outside = closed | (run.electrodes.visible[frames] & ~trusted)
        along = prior.variance_mm2(gains, (FIXED, OFFSET, TILT, BEND), rays)
        # Path and baseline compete here, so that their distance is part of the uncertainty.
        alone = (
            run.lateral_mm2(frames, start)
            + along[..., None, None] * rays[..., :, None] * rays[..., None, :]
            + apart[..., :, None] * apart[..., None, :]
        )
        positions = np.where(outside[..., None], start, paths.positions_mm)
        depth = _depth_by_cause(prior, gains, rays, outside)
        joint = _with_baseline(paths.covariance_mm2, outside, alone)
        return positions, joint, depth, np.broadcast_to(closed, outside.shape)

    def _gated_catheters(self, electrodes: ViewElectrodes, used: BoolArray, deeper: Array, usual: Array) -> BoolArray:
        """Return the electrodes (m,) of catheters whose depth moved too far.

        The view changes that depth by more than the prior allows.
        """
        closed = np.zeros(used.shape[1], dtype=np.bool_)
        names = np.array(electrodes.catheters)
        for name in dict.fromkeys(electrodes.catheters):
            own = used & (names == name)
            if own.any():
                closed[names == name] = (deeper[own] ** 2).mean() > self._params.gate_sd**2 * usual[own].mean()
        return closed

    def _track(
        self, run: _Run, positions: Array, joint: Array, depth: Array, gated: BoolArray, reasons: list[Reason]
    ) -> Track:
        electrodes = run.electrodes
        n, m = electrodes.visible.shape
        joint = joint + _tip_centres_mm2(electrodes, positions, run.view.catalogue, self._params.tip_centre_sd_mm)
        blocks = np.einsum("nmimj->nmij", joint.reshape(n, m, 3, m, 3))
        across = np.eye(3) - run.rays[..., :, None] * run.rays[..., None, :]
        # The prior contains the depth's gantry error. This view's own gantry displaces the electrodes across its rays.
        p, isocentre = self._params, run.view.camera.isocentre_world_mm
        gantry = gantry_angle_covariance_mm2(positions - isocentre, p.gantry_angle_sd_deg)
        gantry = gantry + p.isocentre_sd_mm**2 * np.eye(3)
        if any(Reason.TABLE_MOVED in point.reasons for point in electrodes.a_priori):
            # Nothing shows whether this view or the other one has the table's true place.
            gantry = gantry + run.common_mm2
        gantry = across @ gantry @ across
        absolute = blocks + gantry
        weights, has_reference = _from_reference(electrodes, run.view.catalogue.reference)
        relative = self._relative(positions, joint, weights, across)
        relative = np.where(has_reference[:, None, None, None], relative, absolute)
        depths = np.einsum("cnaa->cna", depth)
        relative_depths = np.einsum("nka,cnab,nkb->cnk", weights, depth, weights, optimize=True)
        shares = StudyShares(
            depths,
            np.where(has_reference[:, None], relative_depths, depths),
            float(np.radians(p.gantry_angle_sd_deg)),
            p.isocentre_sd_mm,
        )
        shown = electrodes.visible[..., None]
        by_electrode = []
        for index, interrupted in enumerate(electrodes.interrupted()):
            own = [Reason.PRIOR_GATE] if gated[:, index].any() else []
            if interrupted:
                own.append(Reason.TRACK_INTERRUPTED)
            by_electrode.append(tuple(dict.fromkeys((*electrodes.a_priori[index].reasons, *reasons, *own))))
        return Track(
            labels=electrodes.labels,
            located=electrodes.visible,
            positions_mm=np.where(shown, positions, 0.0),
            baseline_mm=np.where(shown, run.baseline_mm, 0.0),
            covariance_mm2=np.where(shown[..., None], absolute, 0.0),
            pixels_uv=electrodes.pixels_uv,
            reasons=tuple(by_electrode),
            relative_covariance_mm2=np.where(shown[..., None], relative, 0.0),
            shares=shares,
        )

    def _relative(self, positions: Array, joint: Array, weights: Array, across: Array) -> Array:
        """Return the covariance (n, m, 3, 3) of positions less the reference's mean.

        ``weights`` (n, m, m) subtract that mean.
        """
        n, m = positions.shape[:2]
        parts = joint.reshape(n, m, 3, m, 3)
        own = np.einsum("nka,naibj,nkb->nkij", weights, parts, weights, optimize=True)
        apart = np.einsum("nka,nai->nki", weights, positions)
        turned = across @ gantry_angle_covariance_mm2(apart, self._params.gantry_angle_sd_deg) @ across
        relative: Array = own + turned
        return relative


@dataclass(frozen=True, eq=False)
class _Run:
    """One run with its baseline (n, m, 3), expected positions (n, m, 3) and the unit rays (n, m, 3) through these.

    common_mm2 : (3, 3) covariance of a displacement of all electrodes at all times.
    """

    view: MonoplaneView
    electrodes: ViewElectrodes
    baseline_mm: Array
    rays: Array
    expected_mm: Array
    common_mm2: Array

    def evidence(self, frames: slice, used: BoolArray) -> Evidence:
        electrodes, view = self.electrodes, self.view
        # Without a cycle, two views saw the distances at diastole only: other sites' motion stretches a catheter.
        located = self.expected_mm[frames]
        if view.cycle is None:
            located = np.broadcast_to(electrodes.a_priori_mm, located.shape)
        moments = len(view.cycle.phases) if view.cycle is not None else 1
        variances = np.trace(electrodes.covariance_px2[electrodes.visible], axis1=1, axis2=2) / 2
        pixel_sd_mm = float(np.sqrt(np.median(variances))) / view.camera.px_per_mm
        lengths = catheter_lengths(view.catalogue, electrodes.a_priori, located, moments, pixel_sd_mm)
        return Evidence(
            self.view.camera, electrodes.pixels_uv[frames], electrodes.covariance_px2[frames], used, lengths
        )

    def surprise(self, frames: slice, prior: PathPrior) -> Array:
        return surprise(prior, self.evidence(frames, self.electrodes.visible[frames]), prior.mean_mm)

    def lateral_mm2(self, frames: slice, positions: Array) -> Array:
        jacobians = self.view.camera.jacobian(positions)
        return lateral_covariance_mm2(jacobians, self.electrodes.covariance_px2[frames])

    def mirrored(self) -> _Run:
        """Return the run with a camera whose image is flipped left to right."""
        camera = self.view.camera
        flipped = camera.matrix.copy()
        flipped[0] = 2 * camera.principal_point_uv[0] * camera.matrix[2] - camera.matrix[0]
        return replace(self, view=replace(self.view, camera=replace(camera, matrix=flipped)))


def _from_reference(electrodes: ViewElectrodes, reference: str | None) -> tuple[Array, BoolArray]:
    """Return weights (n, m, m) that subtract the reference's mean, and the frames (n,) that show the reference."""
    is_reference = np.array([name == reference for name in electrodes.catheters])
    visible = electrodes.visible & is_reference
    count = visible.sum(axis=1)
    mean = visible / np.maximum(count, 1)[:, None]
    return np.eye(len(is_reference)) - mean[:, None, :], count > 0


def _tip_centres_mm2(electrodes: ViewElectrodes, positions: Array, catalogue: Catalogue, usual_sd_mm: float) -> Array:
    """Return the joint covariance (n, 3 m, 3 m) from the tips' radiographic centres.

    The centre of a tip in the image is not the middle of its metal. All views show the same centre, so that no pixel reveals
    the distance along the shaft.
    """
    n, m = electrodes.visible.shape
    covariance = np.zeros((n, m, 3, m, 3))
    for tip, (catheter, electrode) in enumerate(electrodes.labels):
        if electrode == 1 and (catheter, 2) in electrodes.labels:
            along = positions[:, tip] - positions[:, electrodes.labels.index((catheter, 2))]
            along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
            sd_mm = catalogue[catheter].tip_centre_sd_mm(usual_sd_mm)
            covariance[:, tip, :, tip] = sd_mm**2 * along[:, :, None] * along[:, None, :]
    return covariance.reshape(n, 3 * m, 3 * m)


def _depth_by_cause(prior: PathPrior, gains: Array, rays: Array, outside: BoolArray) -> Array:
    """Return the covariance (4, n, m, m) of unseen depths from each cause.

    The study scales these causes. Electrodes ``outside`` (n, m) are independent of the others.
    """
    along = np.einsum("nmi,nmiq->nmq", rays, prior.unseen_mm) * np.sqrt(gains)[prior.parts]
    joint = np.stack([
        np.einsum("naq,nbq->nab", of_cause, of_cause)
        for of_cause in (along[..., prior.causes == cause] for cause in range(OTHER))
    ])  # fmt: skip
    together = ~(outside[:, :, None] | outside[:, None, :]) | np.eye(outside.shape[1], dtype=np.bool_)
    found: Array = joint * together
    return found


def _by_catheter(electrodes: ViewElectrodes, found: Array, frames: slice) -> Array:
    """Return the root mean square over each catheter's visible electrodes.

    It is repeated for each electrode, (n, m).
    """
    names = np.array(electrodes.catheters)
    together = np.zeros_like(found)
    for name in dict.fromkeys(electrodes.catheters):
        own = electrodes.visible[frames] & (names == name)
        mean = (np.where(own, found, 0.0) ** 2).sum(axis=1) / np.maximum(own.sum(axis=1), 1)
        together[:, names == name] = np.sqrt(mean)[:, None]
    return together


def _windows(phases: Array) -> Iterator[slice]:
    """Yield windows of about one beat.

    They reach from one wrap of the phase to the next and are never longer than 64 frames.
    """
    wraps = np.flatnonzero(np.diff(phases) < -0.5) + 1
    edges = [0, *wraps.tolist(), len(phases)]
    for first, last in pairwise(edges):
        pieces = -(-(last - first) // _LONGEST_WINDOW)
        cuts = np.linspace(first, last, pieces + 1).astype(int)
        for begin, end in pairwise(cuts):
            yield slice(int(begin), int(end))


def _with_baseline(joint: Array, outside: BoolArray, alone: Array) -> Array:
    """Return the joint covariance (n, 3 m, 3 m) with some electrodes (n, m) at the baseline.

    An electrode at the baseline is independent of the others and has the covariance ``alone`` (n, m, 3, 3).
    """
    if not outside.any():
        return joint
    n, m = outside.shape
    kept = ~outside
    parts = joint.reshape(n, m, 3, m, 3) * (kept[:, :, None] & kept[:, None, :])[:, :, None, :, None]
    for row, column in zip(*np.nonzero(outside), strict=True):
        parts[row, column, :, column] = alone[row, column]
    whole: Array = parts.reshape(n, 3 * m, 3 * m)
    return whole
