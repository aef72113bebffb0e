"""The database rows of a job's points: every electrode of every site, located or rejected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import (
    ElectrodePoint,
    Grade,
    LocatedSite,
    Matching,
    Triangulation,
    grade_of_axis,
    largest_semi_axes_mm,
)
from fluoromap.reasons import Reason
from fluoromap_service.store.models import Json
from fluoromap_service.study.snapshot import RejectedSiteSnapshot, SiteSnapshot, Snapshot

_UPPER = np.triu_indices(3)


def point_rows(job_id: str, snapshot: Snapshot, matching: Matching, triangulation: Triangulation) -> list[Json]:
    """Return the columns of all points of a job, located or rejected.

    Sites that were not ready and sites that could not be located have rows too, with their reasons.
    """
    rows: list[Json] = []
    notes = {site.site: site.notes for site in matching.sites}
    located = {site.site: site for site in triangulation.sites}
    refused = {site.site: site.reasons for site in triangulation.rejected}
    accuracies = _accuracies(triangulation)
    for planned in snapshot.sites:
        site = located.get(planned.site)
        reference_doubts = site.doubts_about(snapshot.reference) if site else ()
        for catheter in snapshot.catalogue.catheters:
            doubts = tuple(reason for name, reason in notes.get(planned.site, ()) if name == catheter.name)
            for electrode in range(1, catheter.electrodes + 1):
                point = site.point(catheter.name, electrode) if site else None
                if point is None or site is None:
                    reasons = refused.get(planned.site) or doubts or (Reason.CATHETER_NOT_FOUND,)
                    rows.append(_rejected(job_id, planned, catheter.name, electrode, reasons))
                else:
                    rows.append(_located(job_id, planned, site, point, doubts, reference_doubts, accuracies[id(point)]))
    for not_ready in snapshot.rejected:
        for catheter in snapshot.catalogue.catheters:
            for electrode in range(1, catheter.electrodes + 1):
                rows.append(_rejected(job_id, not_ready, catheter.name, electrode, not_ready.reasons))
    return rows


@dataclass(frozen=True, slots=True)
class _Accuracy:
    """Largest semi-axis of a point's ellipsoid in mm, and its covariance: xx, xy, xz, yy, yz, zz."""

    semi_axis_mm: float
    covariance_mm2: list[float]


def _accuracies(triangulation: Triangulation) -> dict[int, tuple[_Accuracy, _Accuracy | None]]:
    """Return the accuracy of each point from the isocentre and from the reference catheter.

    One decomposition serves all points. The keys are the ids of the points. The second accuracy may be missing.
    """
    points = [point for site in triangulation.sites for point in site.points]
    if not points:
        return {}
    relative = {id(point): point.relative_covariance_mm2 for point in points}
    known = {point: covariance for point, covariance in relative.items() if covariance is not None}
    covariances = np.array([*(point.covariance_mm2 for point in points), *known.values()])
    sixes: list[list[float]] = covariances[:, *_UPPER].tolist()
    found = list(map(_Accuracy, largest_semi_axes_mm(covariances), sixes))
    of_relative = dict(zip(known, found[len(points) :], strict=True))
    return {id(point): (own, of_relative.get(id(point))) for point, own in zip(points, found, strict=False)}


def _located(
    job_id: str, planned: SiteSnapshot, site: LocatedSite, point: ElectrodePoint, doubts: tuple[Reason, ...],
    reference_doubts: tuple[Reason, ...], accuracies: tuple[_Accuracy, _Accuracy | None],
) -> Json:  # fmt: skip
    accuracy, relative = accuracies
    own = (*point.reasons, *site.reasons, *doubts)
    relative_own = own if relative is None else (*own, *reference_doubts)
    reasons = dict.fromkeys(relative_own)
    if relative is None:
        reasons[Reason.NO_REFERENCE] = None
    return {
        "job_id": job_id,
        "site": planned.site,
        "catheter": point.catheter,
        "electrode": point.electrode,
        "position_mm": point.position_mm.tolist(),
        "covariance_mm2": accuracy.covariance_mm2,
        "relative_mm": point.relative_mm.tolist() if point.relative_mm is not None else None,
        "relative_covariance_mm2": None if relative is None else relative.covariance_mm2,
        "view_a": planned.view_a,
        "view_b": planned.view_b,
        "frame_a": site.frame_a + 1,
        "frame_b": site.frame_b + 1,
        "residual_a_px": point.residual_px[0],
        "residual_b_px": point.residual_px[1],
        "ray_angle_deg": point.ray_angle_deg,
        "lat_ms": planned.lat_ms,
        "grade": grade_of_axis(accuracy.semi_axis_mm, own),
        "relative_grade": Grade.REJECTED if relative is None else grade_of_axis(relative.semi_axis_mm, relative_own),
        "reasons": [str(reason) for reason in reasons],
    }


def _rejected(
    job_id: str,
    planned: SiteSnapshot | RejectedSiteSnapshot,
    catheter: str,
    electrode: int,
    reasons: tuple[Reason, ...],
) -> Json:
    return {
        "job_id": job_id,
        "site": planned.site,
        "catheter": catheter,
        "electrode": electrode,
        "view_a": planned.view_a,
        "view_b": planned.view_b,
        "lat_ms": planned.lat_ms,
        "grade": Grade.REJECTED,
        "relative_grade": Grade.REJECTED,
        "reasons": [str(reason) for reason in reasons],
    }
