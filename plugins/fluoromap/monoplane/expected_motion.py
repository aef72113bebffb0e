"""Expected motion in a single view, from two views: mean and uncertainty of the prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue, follows_tip
from fluoromap.contracts import Array, MonoplaneView, SiteCycle
from fluoromap.matching.beats import cycle_spread
from fluoromap.monoplane.a_priori_lm import motion_variance_share
from fluoromap.monoplane.cycle_prior import CycleCurve, fit_cycle
from fluoromap.monoplane.motion_field import displacements
from fluoromap.monoplane.view_electrodes import ViewElectrodes, gantry_angle_covariance_mm2
from fluoromap.reasons import Reason

READING_SD_FRAMES = 0.29
"""An R wave is timed to the nearest frame: standard deviation of a uniform distribution one frame wide."""
SYSTOLE_PHASE = 0.3
"""Phase of systole. In irregular cycles it keeps its time after the R wave, so that its phase varies with their lengths."""


@dataclass(frozen=True, eq=False)
class ExpectedMotion:
    """Expected positions of m electrodes in the n frames of a run.

    mean_mm : (n, m, 3) world. moved_mm : (n, m, 3) displacement from diastole; a stronger beat enlarges it. velocity_mm :
    (n, m, 3) by phase, mm a cycle. curved_mm : (n, m, 3) second-order displacement where systole shifts in phase because the
    cycles differ in length; 0 in a regular rhythm. offset_sd_mm : (n, m) an axis, of a catheter as a whole, without
    beat-to-beat variation. common_mm2 : (3, 3) covariance of a displacement of all electrodes at all times. beats : number of
    cardiac cycles in the mean; 0 where no cycle is known. own_cycle : the mean is the site's own cycle. frames_per_cycle : of the
    run. cycle_spread : of the cycles' lengths, as a share. reasons : doubts about the expectation.
    """

    mean_mm: Array
    moved_mm: Array
    velocity_mm: Array
    curved_mm: Array
    offset_sd_mm: Array
    common_mm2: Array
    beats: float
    own_cycle: bool
    frames_per_cycle: float
    cycle_spread: float
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, slots=True)
class Pace:
    """Cardiac cycles of a run. cycles : their number. frames_per_cycle : median. spread : of their lengths, as a share."""

    cycles: float
    frames_per_cycle: float
    spread: float


def pace_of(phases: Array) -> Pace:
    """Return the pace of a run from the phases of its frames, all known."""
    steps = np.diff(phases) % 1.0
    if len(steps) == 0 or not (steps > 0).any():
        return Pace(1.0, 1.0, 0.0)
    middle = float(np.median(steps[steps > 0]))
    spread = cycle_spread(phases)
    # A cycle lasts from one R wave to the next; each is timed to the nearest frame.
    reading = np.sqrt(2) * READING_SD_FRAMES * middle
    return Pace(max(float(steps.sum()), 1.0), 1.0 / middle, float(np.sqrt(max(spread**2 - reading**2, 0.0))))


def expected_motion(
    view: MonoplaneView,
    electrodes: ViewElectrodes,
    mapping_sd_mm: float,
    other_sd_mm: float,
    beat_sd_mm: float,
    gantry_angle_sd_deg: float,
) -> ExpectedMotion:
    """Return the expected motion from the best source there is.

    The sources, best first: the site's own cycle, the other sites' cycles, no motion.

    Parameters
    ----------
    mapping_sd_mm, other_sd_mm : float
        Motion of the mapping catheter and of the others over the cycle, an axis, where no cycle is known.
    beat_sd_mm : float
        Variation of a catheter's place from beat to beat, an axis. The points' covariances contain it.
    gantry_angle_sd_deg : float
        Error of each gantry angle. The points' covariances contain it too.
    """
    known = bool(np.isfinite(electrodes.phases).all())
    pace = pace_of(electrodes.phases) if known else Pace(0.0, 1.0, 0.0)
    if known and view.cycle is not None:
        return _from_own_cycle(
            view, electrodes, view.cycle, pace, mapping_sd_mm, other_sd_mm, beat_sd_mm, gantry_angle_sd_deg
        )
    n, m = electrodes.visible.shape
    points = np.array([point.covariance_mm2 for point in electrodes.a_priori])
    others = _other_errors_mm2(
        electrodes.a_priori_mm, electrodes.labels, view.catalogue, beat_sd_mm, gantry_angle_sd_deg,
        view.camera.isocentre_world_mm,
    )  # fmt: skip
    common = _common_covariance(points - others)
    sd = np.array([mapping_sd_mm if name == view.catalogue.mapping else other_sd_mm for name in electrodes.catheters])
    unknown_sd = np.sqrt(motion_variance_share(electrodes.phases, view.a_priori_frame))[:, None] * sd
    still = np.zeros((n, m, 3))
    if known and view.others:
        curves = [fit_cycle(cycle) for cycle in view.others]
        start = float(electrodes.phases[view.a_priori_frame])
        field = displacements(
            curves, electrodes.labels, electrodes.a_priori_mm, electrodes.phases, start, view.catalogue.mapping
        )
        offset = np.where(np.isfinite(field.sd_mm), field.sd_mm, unknown_sd)
        return ExpectedMotion(
            electrodes.a_priori_mm + field.moved_mm, field.moved_mm, field.velocity_mm, still, offset, common, 1.0, False,
            pace.frames_per_cycle, pace.spread, (Reason.MOTION_FROM_OTHERS,),
        )  # fmt: skip
    reasons = (Reason.DEPTH_ASSUMED,) if known else (Reason.DEPTH_ASSUMED, Reason.PHASE_UNKNOWN)
    return ExpectedMotion(
        electrodes.a_priori_mm + still, still, still, still, unknown_sd, common, 0.0, False, pace.frames_per_cycle, 0.0,
        reasons,
    )  # fmt: skip


def _from_own_cycle(
    view: MonoplaneView,
    electrodes: ViewElectrodes,
    cycle: SiteCycle,
    pace: Pace,
    mapping_sd_mm: float,
    other_sd_mm: float,
    beat_sd_mm: float,
    gantry_angle_sd_deg: float,
) -> ExpectedMotion:
    curve = fit_cycle(cycle)
    start = electrodes.phases[view.a_priori_frame : view.a_priori_frame + 1]
    rest, places = curve.positions_mm(start)[0], curve.positions_mm(electrodes.phases)
    slopes = curve.velocities_mm(electrodes.phases)
    bends = _curvature_mm(curve, electrodes.phases, SYSTOLE_PHASE * pace.spread)
    n, m = electrodes.visible.shape
    mean, velocity, curved = np.empty((n, m, 3)), np.empty((n, m, 3)), np.empty((n, m, 3))
    moved, offset = np.empty((n, m, 3)), np.empty((n, m))
    share = np.sqrt(motion_variance_share(electrodes.phases, view.a_priori_frame))
    # The beats' scatter is a part of its own in the prior; only gaps in the cycle remain here.
    unsure = np.sqrt(np.maximum(curve.sd_mm(electrodes.phases) ** 2 - beat_sd_mm**2 / pace.cycles, 0.0))
    for index, label in enumerate(electrodes.labels):
        row = _nearest(curve, label)
        if row is None:
            mean[:, index] = electrodes.a_priori_mm[index]
            moved[:, index], velocity[:, index], curved[:, index] = 0.0, 0.0, 0.0
            offset[:, index] = share * (mapping_sd_mm if label[0] == view.catalogue.mapping else other_sd_mm)
            continue
        moved[:, index], velocity[:, index] = places[:, row] - rest[row], slopes[:, row]
        curved[:, index] = bends[:, row]
        known = curve.labels[row] == label
        mean[:, index] = places[:, row] if known else electrodes.a_priori_mm[index] + moved[:, index]
        offset[:, index] = unsure
    others = _other_errors_mm2(
        cycle.positions_mm,
        cycle.labels,
        view.catalogue,
        beat_sd_mm,
        gantry_angle_sd_deg,
        view.camera.isocentre_world_mm,
    )
    common = _common_covariance((cycle.covariance_mm2 - others).reshape(-1, 3, 3))
    return ExpectedMotion(
        mean, moved, velocity, curved, offset, common, pace.cycles, True, pace.frames_per_cycle, pace.spread, ()
    )


def _curvature_mm(curve: CycleCurve, phases: Array, shift_sd: float) -> Array:
    """Return the second-order displacement (n, m, 3) of a shift in phase.

    It is the root mean square over normal shifts with the standard deviation ``shift_sd``.
    """
    # The fourth moment of a normal distribution is 3 sd^4.
    shift = 3**0.25 * shift_sd
    earlier, later = (curve.positions_mm(phases + one) for one in (-shift, shift))
    curvature: Array = (earlier + later) / 2 - curve.positions_mm(phases)
    return curvature


def _nearest(curve: CycleCurve, label: tuple[str, int]) -> int | None:
    """Return the cycle's row of the electrode, or of the nearest electrode on its catheter.

    The result is None without either.
    """
    rows = [row for row, (name, _) in enumerate(curve.labels) if name == label[0]]
    return min(rows, key=lambda row: abs(curve.labels[row][1] - label[1]), default=None)


def _other_errors_mm2(
    positions_mm: Array,
    labels: tuple[tuple[str, int], ...],
    catalogue: Catalogue,
    beat_sd_mm: float,
    angle_sd_deg: float,
    isocentre_mm: Array,
) -> Array:
    """Return the share of beats and gantry angles in the covariances (..., m, 3, 3) of positions (..., m, 3)."""
    follows = follows_tip(positions_mm, labels, catalogue)
    beats: Array = beat_sd_mm**2 * follows @ np.swapaxes(follows, -1, -2)
    return beats + gantry_angle_covariance_mm2(positions_mm - isocentre_mm, angle_sd_deg)


def _common_covariance(covariances_mm2: Array) -> Array:
    """Return the covariance (3, 3) common to the covariances (k, 3, 3) of electrodes.

    Breathing and the isocentre displace all electrodes alike, so that the most certain electrode contains them too. The
    caller first subtracts beat-to-beat variation and gantry angles, which affect each electrode differently. The minimum
    is taken along the principal axes of the mean covariance.
    """
    _, axes = np.linalg.eigh(covariances_mm2.mean(axis=0))
    along = np.einsum("ik,nij,jk->nk", axes, covariances_mm2, axes)
    common: Array = (axes * np.maximum(along.min(axis=0), 0.0)) @ axes.T
    return common
