"""Epipolar lines: the ray of a pixel of one view, drawn in the other view."""

from __future__ import annotations

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap.contracts import Array, Triangulation
from fluoromap.geometry import Camera
from fluoromap_service.dicom.facts import Point
from fluoromap_service.jobs.stage_results import load
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.results.finished import snapshot_of
from fluoromap_service.store.models import Job, StageRow, StageState
from fluoromap_service.study.instances import runs_of
from fluoromap_service.study.snapshot import GantrySnapshot
from fluoromap_service.study.table_offsets import table_offsets_mm

REACH_MM = 150.0
"""Half length of the ray about the isocentre; hearts lie within it."""


def epipolar_line(session: Session, study_id: str, uid: str, other: str, pixel_uv: Array) -> Array:
    """Return the ends (2, 2) of a pixel's epipolar line in stored pixels.

    The cameras are those of the newest job that located a site by these two runs, which contain the self-calibration. Without
    such a job they follow from the gantry of each run.

    Parameters
    ----------
    session : Session
    study_id : str
    uid, other : str
        SOP Instance UID of the run with the pixel, and of the run that shows the line.
    pixel_uv : (2,)

    Raises
    ------
    Problem
        404 for a run that the study does not have, 409 ``no_geometry`` while the gantry of one of the runs is incomplete.
    """
    cameras = _calibrated(session, study_id, uid, other) or _from_gantry(session, study_id, uid, other)
    first, second = cameras
    middle = float(first.depth_mm(np.zeros((1, 3)))[0])
    reach = min(REACH_MM, middle / 2)
    depths = np.array([middle - reach, middle + reach])
    ends: Array = second.project(first.back_project(np.stack([pixel_uv, pixel_uv]), depths))
    return ends


def _calibrated(session: Session, study_id: str, uid: str, other: str) -> tuple[Camera, Camera] | None:
    row = session.execute(
        select(Job, StageRow)
        .join(StageRow, StageRow.job_id == Job.id)
        .where(Job.study_id == study_id, StageRow.name == "triangulate", StageRow.state == StageState.DONE)
        .order_by(Job.created.desc(), Job.id)
        .limit(1)
    ).first()
    if row is None:
        return None
    snapshot = snapshot_of(row[0])
    for site in load(Triangulation, row[1]).sites:
        runs = snapshot.site(site.site)
        if {runs.view_a, runs.view_b} == {uid, other}:
            a, b = site.camera("a"), site.camera("b")
            return (a, b) if runs.view_a == uid else (b, a)
    return None


def _from_gantry(session: Session, study_id: str, uid: str, other: str) -> tuple[Camera, Camera]:
    runs = {run.uid: run for run in runs_of(session, study_id)}
    if not {uid, other} <= set(runs):
        raise not_found("instance in this study")
    offsets = table_offsets_mm(run.facts for run in runs.values())
    first, second = (_camera(runs[each].geometry, offsets.get(each)) for each in (uid, other))
    return first, second


def _camera(gantry: GantrySnapshot | None, offset_mm: Point | None) -> Camera:
    if gantry is None:
        detail = "An epipolar line needs the gantry's geometry of both runs; complete the values that are missing."
        raise Problem(409, "no_geometry", detail)
    return gantry.model_copy(update={} if offset_mm is None else {"table_offset_mm": offset_mm}).camera()
