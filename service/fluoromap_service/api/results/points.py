"""The routes of the electrode positions at diastole."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from fastapi import Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from fluoromap.contracts import Grade, Triangulation
from fluoromap.reasons import Reason
from fluoromap_service.api.http.csv_answers import csv_entry, csv_response, csv_text, wants_csv
from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.results.origins import FrameOfReference, OriginQuery, Six
from fluoromap_service.api.results.study_geometry import StudyGeometry, study_geometry
from fluoromap_service.jobs.stage_results import load
from fluoromap_service.results.finished import done_stage, job_of, snapshot_of
from fluoromap_service.results.origins import Origin, origin_in
from fluoromap_service.results.points import point_rows
from fluoromap_service.results.row_order import sites_by_row_order
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job
from fluoromap_service.store.models import Point as PointRow

router = new_router(tags=["results"])


class PointView(BaseModel):
    """The run and the frame that located a point."""

    sop_instance_uid: str
    frame: int | None = Field(description="Counted from 1; null where the site has no position.")


class PointViews(BaseModel):
    """Both views of a point."""

    a: PointView | None
    b: PointView | None


class Residuals(BaseModel):
    """Distance in each view between the electrode's pixel and the projection of its position."""

    a: float | None
    b: float | None


class Point(BaseModel):
    """One electrode of one site. A rejected one has no position; its ``reasons`` say why."""

    site: str
    catheter: str
    electrode: int = Field(description="1 is the tip.")
    x_mm: float | None
    y_mm: float | None
    z_mm: float | None
    covariance_mm2: Six | None = Field(description="xx, xy, xz, yy, yz, zz of the position from the chosen origin.")
    views: PointViews
    residual_px: Residuals
    ray_angle_deg: float | None = Field(description="Angle between the two views' rays at this electrode.")
    lat_ms: float | None = Field(description="The site's activation time: mapping minus reference.")
    grade: Grade = Field(description="A: largest 95 % semi-axis up to 2 mm; B: up to 4 mm; C: beyond.")
    reasons: list[Reason]


EXAMPLE: dict[str, Any] = {
    "frame": {"axes": "LPS", "origin": "reference", "unit": "mm"},
    "points": [
        {
            "site": "S03", "catheter": "mapping", "electrode": 1, "x_mm": 31.2, "y_mm": -8.4, "z_mm": 12.9,
            "covariance_mm2": [0.21, 0.0, 0.01, 0.18, 0.0, 0.2],
            "views": {
                "a": {"sop_instance_uid": "1.2.826.0.1.3680043.8.498.1", "frame": 37},
                "b": {"sop_instance_uid": "1.2.826.0.1.3680043.8.498.2", "frame": 12},
            },
            "residual_px": {"a": 0.31, "b": 0.27}, "ray_angle_deg": 88.7, "lat_ms": 41.0, "grade": "A", "reasons": [],
        }
    ],
    "calibration": {
        "applied": True, "rotation_deg": [0.4, -0.9, 0.2], "offset_mm": [0.3, -1.1, 1.6], "epipolar_before_px": 5.4,
        "epipolar_after_px": 0.5,
    },
    "error_budget": {
        "pixels_mm": 0.14, "angles_mm": 0.31, "source_distances_mm": 0.52, "phase_mismatch_mm": 0.41, "breathing_mm": 0.94,
    },
    "notes": ["S04: the views are 17 degrees apart; at least 20 are needed."],
    "alternatives": [
        {
            "site": "S03", "catheter": "pacing", "electrode": 2, "x_mm": 12.4, "y_mm": -3.1, "z_mm": 7.7, "probability": 0.2,
        }
    ],
}  # fmt: skip


class Points(StudyGeometry):
    """All points of a job, with facts about the whole study."""

    model_config = ConfigDict(json_schema_extra={"examples": [EXAMPLE]})

    frame: FrameOfReference
    points: list[Point]


COLUMNS = (
    "site", "catheter", "electrode", "x_mm", "y_mm", "z_mm",
    "cov_xx_mm2", "cov_xy_mm2", "cov_xz_mm2", "cov_yy_mm2", "cov_yz_mm2", "cov_zz_mm2",
    "frame_a", "frame_b", "residual_a_px", "residual_b_px", "ray_angle_deg", "lat_ms", "grade", "reasons",
)  # fmt: skip
CSV_ENTRY = csv_entry(
    "One line a point; reasons joined by ';', the numbers of a rejected point empty.",
    ",".join(COLUMNS) + "\r\nS03,mapping,1,31.2,-8.4,12.9,0.21,0.0,0.01,0.18,0.0,0.2,37,12,0.31,0.27,88.7,41.0,A,\r\n",
)


def points_of(session: Session, job: Job, origin: Origin) -> list[Point]:
    """Return all points of a job, located or rejected.

    Raises
    ------
    Problem
        409 ``not_ready`` before the stage ``triangulate`` is done.
    """
    guessed, origin = sites_by_row_order(session, job), origin_in(job, origin)
    return [_point(row, origin, row.site in guessed) for row in point_rows(session, job)]


def _point(row: PointRow, origin: Origin, guessed: bool) -> Point:
    relative = origin is Origin.REFERENCE
    position: Any = row.relative_mm if relative else row.position_mm
    covariance: Any = row.relative_covariance_mm2 if relative else row.covariance_mm2
    x, y, z = position or (None, None, None)
    return Point(
        site=row.site,
        catheter=row.catheter,
        electrode=row.electrode,
        x_mm=x,
        y_mm=y,
        z_mm=z,
        covariance_mm2=covariance,
        views=PointViews(a=_view(row.view_a, row.frame_a), b=_view(row.view_b, row.frame_b)),
        residual_px=Residuals(a=row.residual_a_px, b=row.residual_b_px),
        ray_angle_deg=row.ray_angle_deg,
        lat_ms=row.lat_ms,
        grade=Grade(row.relative_grade if relative else row.grade),
        reasons=[*row.reasons, *([Reason.PAIRED_BY_ORDER] if guessed else [])],
    )


def _view(uid: str | None, frame: int | None) -> PointView | None:
    return None if uid is None else PointView(sop_instance_uid=uid, frame=frame)


def points_csv(points: list[Point]) -> str:
    """Return points as CSV, one line a point."""
    return csv_text(COLUMNS, _lines(points))


def _lines(points: list[Point]) -> Iterator[list[Any]]:
    for point in points:
        views = point.views
        yield [
            point.site, point.catheter, point.electrode, point.x_mm, point.y_mm, point.z_mm,
            *(point.covariance_mm2 or [None] * 6),
            views.a.frame if views.a else None, views.b.frame if views.b else None,
            point.residual_px.a, point.residual_px.b, point.ray_angle_deg, point.lat_ms,
            point.grade.value, ";".join(point.reasons),
        ]  # fmt: skip


def _read(job_id: str, origin: Origin) -> Points:
    with reading() as session:
        job = job_of(session, job_id)
        origin = origin_in(job, origin)
        points = points_of(session, job, origin)
        triangulation = load(Triangulation, done_stage(session, job, "triangulate"))
        study = study_geometry(triangulation, snapshot_of(job).reference, origin)
    return Points(frame=FrameOfReference(origin=origin), points=points, **dict(study))


@router.get(
    "/v1/jobs/{job_id}/points",
    summary="Electrode positions",
    response_model=Points,
    responses={200: {"content": CSV_ENTRY}, **responses(401, 403, 404, 409, 422)},
)
def get_points(
    job_id: JobId, request: Request, response: Response, caller: Reader, origin: OriginQuery = Origin.REFERENCE
) -> Points | Response:
    """Return every electrode of every site, with covariance, residuals and grade.

    `Accept: text/csv` gives CSV. The points are available as soon as the stage `triangulate` is done; before that the answer
    is 409 `not_ready`. A site without a located reference catheter has positions from the isocentre only. The JSON answer
    also contains facts about the whole study: the gantry's self-calibration, the error budget, and the positions of
    electrodes under the other pairing of the catheters.
    """
    points = _read(job_id, origin)
    if wants_csv(request):
        return csv_response(points_csv(points.points), "points.csv")
    response.headers["Vary"] = "Accept"
    return points


@router.get(
    "/v1/jobs/{job_id}/points.csv",
    summary="Electrode positions as CSV",
    response_class=Response,
    responses={200: {"content": CSV_ENTRY}, **responses(401, 403, 404, 409, 422)},
)
def get_points_csv(job_id: JobId, caller: Reader, origin: OriginQuery = Origin.REFERENCE) -> Response:
    """Return the same points as `points`, always as CSV."""
    return csv_response(points_csv(_read(job_id, origin).points), "points.csv")
