"""What two views have told about the motion that one view is about to show: the prior's mean and how wrong it may be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue, follows_tip
from fluoromap.contracts import Array, MonoplaneView, SiteCycle
from fluoromap.monoplane.a_priori_lm import moved_share
from fluoromap.monoplane.cycle_prior import CycleCurve, fit_cycle
from fluoromap.monoplane.motion_field import displacements
from fluoromap.monoplane.observed_view import ObservedView, turned_covariance_mm2
from fluoromap.reasons import Reason


@dataclass(frozen=True, eq=False)
class ExpectedMotion:
    """Where the m electrodes are expected in the n frames of a run.

    mean_mm : (n, m, 3). moved_mm : (n, m, 3) displacement from diastole, which a stronger beat enlarges. velocity_mm :
    (n, m, 3) by phase, mm a cycle. offset_sd_mm : (n, m) an axis, of a catheter as a whole, beyond beats that differ.
    common_mm2 : (3, 3) covariance of a displacement of all electrodes at all times. beats : cardiac cycles over which the
    mean was averaged; 0 where each frame is on its own. frames_per_cycle : of the run. reasons : what speaks against
    trusting it fully.
    """

    mean_mm: Array
    moved_mm: Array
    velocity_mm: Array
    offset_sd_mm: Array
    common_mm2: Array
    beats: float
    own_cycle: bool
    frames_per_cycle: float
    cycle_spread: float
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, slots=True)
class Pace:
    """The cardiac cycles of a run. cycles : how many it holds. frames_per_cycle. spread : of their lengths, as a share."""

    cycles: float
    frames_per_cycle: float
    spread: float


def pace_of(phases: Array) -> Pace:
    """From the phases of a run's frames, all known."""
    steps = np.diff(phases) % 1.0
    if len(steps) == 0 or not (steps > 0).any():
        return Pace(1.0, 1.0, 0.0)
    middle = float(np.median(steps[steps > 0]))
    beat = np.cumsum(np.concatenate([[0], np.diff(phases) < -0.5]))
    rates = [steps[beat[1:] == number].mean() for number in np.unique(beat) if (beat[1:] == number).sum() > 2]
    spread = float(np.std(rates) / np.mean(rates)) if len(rates) > 1 else 0.0
    return Pace(max(float(steps.sum()), 1.0), 1.0 / middle, spread)


def expect(
    view: MonoplaneView,
    observed: ObservedView,
    mapping_sd_mm: float,
    other_sd_mm: float,
    beat_sd_mm: float,
    gantry_angle_sd_deg: float,
) -> ExpectedMotion:
    """The best knowledge there is of the motion: the site's own cycle, the other sites' cycles, or none.

    Parameters
    ----------
    mapping_sd_mm, other_sd_mm : float
        How far the mapping catheter and the others may move over the cycle, an axis, where nothing tells.
    beat_sd_mm : float
        How far a catheter's place varies from beat to beat, an axis; contained in the points' own covariances.
    gantry_angle_sd_deg : float
        Error of each gantry angle; contained in the points' own covariances as well.
    """
    known = bool(np.isfinite(observed.phases).all())
    pace = pace_of(observed.phases) if known else Pace(0.0, 1.0, 0.0)
    if known and view.cycle is not None:
        return _from_own_cycle(
            view, observed, view.cycle, pace, mapping_sd_mm, other_sd_mm, beat_sd_mm, gantry_angle_sd_deg
        )
    n, m = observed.seen.shape
    points = np.array([point.covariance_mm2 for point in observed.a_priori])
    others = _other_errors_mm2(observed.a_priori_mm, observed.labels, view.catalogue, beat_sd_mm, gantry_angle_sd_deg)
    common = _common_covariance(points - others)
    sd = np.array([mapping_sd_mm if name == view.catalogue.mapping else other_sd_mm for name in observed.catheters])
    unknown_sd = np.sqrt(moved_share(observed.phases, view.a_priori_frame))[:, None] * sd
    still = np.zeros((n, m, 3))
    if known and view.others:
        curves = [fit_cycle(cycle) for cycle in view.others]
        start = float(observed.phases[view.a_priori_frame])
        field = displacements(
            curves, observed.labels, observed.a_priori_mm, observed.phases, start, view.catalogue.mapping
        )
        offset = np.where(np.isfinite(field.sd_mm), field.sd_mm, unknown_sd)
        return ExpectedMotion(
            observed.a_priori_mm + field.moved_mm, field.moved_mm, field.velocity_mm, offset, common, 1.0, False,
            pace.frames_per_cycle, pace.spread, (Reason.MOTION_FROM_OTHERS,),
        )  # fmt: skip
    reasons = (Reason.DEPTH_ASSUMED,) if known else (Reason.DEPTH_ASSUMED, Reason.PHASE_UNKNOWN)
    return ExpectedMotion(
        observed.a_priori_mm + still, still, still, unknown_sd, common, 0.0, False, pace.frames_per_cycle, 0.0,
        reasons,
    )  # fmt: skip


def _from_own_cycle(
    view: MonoplaneView,
    observed: ObservedView,
    cycle: SiteCycle,
    pace: Pace,
    mapping_sd_mm: float,
    other_sd_mm: float,
    beat_sd_mm: float,
    gantry_angle_sd_deg: float,
) -> ExpectedMotion:
    curve = fit_cycle(cycle)
    start = observed.phases[view.a_priori_frame : view.a_priori_frame + 1]
    rest, places = curve.positions_mm(start)[0], curve.positions_mm(observed.phases)
    slopes = curve.velocities_mm(observed.phases)
    n, m = observed.seen.shape
    mean, velocity = np.empty((n, m, 3)), np.empty((n, m, 3))
    moved, offset = np.empty((n, m, 3)), np.empty((n, m))
    share = np.sqrt(moved_share(observed.phases, view.a_priori_frame))
    # The scatter of beats is told apart from this; what is left are gaps in the cycle.
    unsure = np.sqrt(np.maximum(curve.sd_mm(observed.phases) ** 2 - beat_sd_mm**2 / pace.cycles, 0.0))
    for index, label in enumerate(observed.labels):
        row = _nearest(curve, label)
        if row is None:
            mean[:, index], moved[:, index], velocity[:, index] = observed.a_priori_mm[index], 0.0, 0.0
            offset[:, index] = share * (mapping_sd_mm if label[0] == view.catalogue.mapping else other_sd_mm)
            continue
        moved[:, index], velocity[:, index] = places[:, row] - rest[row], slopes[:, row]
        known = curve.labels[row] == label
        mean[:, index] = places[:, row] if known else observed.a_priori_mm[index] + moved[:, index]
        offset[:, index] = unsure
    others = _other_errors_mm2(cycle.positions_mm, cycle.labels, view.catalogue, beat_sd_mm, gantry_angle_sd_deg)
    common = _common_covariance((cycle.covariance_mm2 - others).reshape(-1, 3, 3))
    return ExpectedMotion(
        mean, moved, velocity, offset, common, pace.cycles, True, pace.frames_per_cycle, pace.spread, ()
    )


def _nearest(curve: CycleCurve, label: tuple[str, int]) -> int | None:
    """Row of the electrode in the cycle, or of the one nearest to it on its catheter; None where there is none."""
    rows = [row for row, (name, _) in enumerate(curve.labels) if name == label[0]]
    return min(rows, key=lambda row: abs(curve.labels[row][1] - label[1]), default=None)


def _other_errors_mm2(
    positions_mm: Array,
    labels: tuple[tuple[str, int], ...],
    catalogue: Catalogue,
    beat_sd_mm: float,
    angle_sd_deg: float,
) -> Array:
    """What beats that differ and wrong gantry angles add to the covariances (..., m, 3, 3) of positions (..., m, 3)."""
    follows = follows_tip(positions_mm, labels, catalogue)
    beats: Array = beat_sd_mm**2 * follows @ np.swapaxes(follows, -1, -2)
    return beats + turned_covariance_mm2(positions_mm, angle_sd_deg)


def _common_covariance(covariances_mm2: Array) -> Array:
    """What covariances (k, 3, 3) of electrodes have in common, (3, 3).

    Breathing and the isocentre displace all electrodes alike and are what the most certain electrode has as well. What
    beats that differ and wrong gantry angles do, to each electrode in another way, must be taken off before. Directions are
    the principal ones of the mean covariance.
    """
    _, axes = np.linalg.eigh(covariances_mm2.mean(axis=0))
    along = np.einsum("ik,nij,jk->nk", axes, covariances_mm2, axes)
    common: Array = (axes * np.maximum(along.min(axis=0), 0.0)) @ axes.T
    return common
