"""The electrodes followed in 3D through one view, every frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from fluoromap.contracts import Grade, Triangulation, View
from fluoromap.fuser.mapped_sites import map_origin
from fluoromap.reasons import Reason
from fluoromap_service.api.http.csv_answers import csv_entry, csv_response, csv_text, wants_csv
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.jobs.finished import done_stage, job_of, not_ready, snapshot_of
from fluoromap_service.api.results.origins import FrameOfReference, Origin, OriginQuery, Position, Six
from fluoromap_service.api.results.track_samples import Sample, camera_of, isocentre, reference, samples
from fluoromap_service.jobs.stage_results import SiteTracks, load, stages_of
from fluoromap_service.problem import not_found
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job, StageRow, StageState
from fluoromap_service.study.snapshot import Snapshot

router = APIRouter(tags=["results"])

_UPPER = np.triu_indices(3)


class TrackSample(BaseModel):
    """An electrode in one frame; without a position where ``grade`` is rejected."""

    frame: int = Field(description="Counted from 1.")
    x_mm: float | None
    y_mm: float | None
    z_mm: float | None
    along_ray_sd_mm: float | None = Field(description="Standard deviation along this view's ray: the depth.")
    lateral_sd_mm: float | None = Field(description="Standard deviation across the ray, RMS of both directions.")
    covariance_mm2: Six | None = Field(
        description=(
            "xx, xy, xz, yy, yz, zz; with origin `reference` of the position less the reference's of the same frame where the "
            "solver tells it, else of the position from the isocentre."
        )
    )
    baseline_mm: Position | None = Field(description="Plain back-projection at the known depth, for comparison.")
    u_px: float | None
    v_px: float | None
    grade: Grade
    reasons: list[Reason]


class ElectrodeTrack(BaseModel):
    """One electrode through all frames of one view."""

    site: str
    view: Literal["a", "b"]
    catheter: str
    electrode: int
    solver: str = Field(description="The monoplane plugin.")
    samples: list[TrackSample]


class RejectedTrack(BaseModel):
    """A view that could not be followed, and why."""

    site: str
    view: Literal["a", "b"]
    reasons: list[Reason]
    message: str


class Tracks(BaseModel):
    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "frame": {"axes": "LPS", "origin": "reference", "unit": "mm"},
                    "tracks": [
                        {
                            "site": "S03", "view": "a", "catheter": "mapping", "electrode": 1, "solver": "motion-prior",
                            "samples": [
                                {
                                    "frame": 1, "x_mm": 31.2, "y_mm": -8.4, "z_mm": 12.9, "along_ray_sd_mm": 1.4,
                                    "lateral_sd_mm": 0.2, "covariance_mm2": [0.1, 0.0, 0.0, 1.9, 0.0, 0.1],
                                    "baseline_mm": [31.3, -8.0, 12.9], "u_px": 271.3, "v_px": 240.8, "grade": "B",
                                    "reasons": [],
                                }
                            ],
                        }
                    ],
                    "rejected": [
                        {
                            "site": "S07", "view": "b", "reasons": ["no_a_priori"],
                            "message": "No biplane position is known here; a single view alone cannot tell depth.",
                        }
                    ],
                }
            ]
        }
    )  # fmt: skip

    frame: FrameOfReference
    tracks: list[ElectrodeTrack]
    rejected: list[RejectedTrack] = Field(description="Views without tracks.")


COLUMNS = (
    "site", "view", "catheter", "electrode", "solver", "frame", "x_mm", "y_mm", "z_mm", "along_ray_sd_mm",
    "lateral_sd_mm", "cov_xx_mm2", "cov_xy_mm2", "cov_xz_mm2", "cov_yy_mm2", "cov_yz_mm2", "cov_zz_mm2",
    "baseline_x_mm", "baseline_y_mm", "baseline_z_mm", "u_px", "v_px", "grade", "reasons",
)  # fmt: skip
CSV_ENTRY = csv_entry(
    "One line an electrode and frame; a rejected view is one line without catheter and frame.",
    ",".join(COLUMNS) + "\r\nS03,a,mapping,1,motion-prior,1,31.2,-8.4,12.9,1.4,0.2,0.1,0.0,0.0,1.9,0.0,0.1,"
    "31.3,-8.0,12.9,271.3,240.8,B,\r\n",
)

SiteQuery = Annotated[str | None, Query(description="Only this site; without it all sites.", examples=["S03"])]
ViewQuery = Annotated[Literal["a", "b"] | None, Query(description="Only this view; without it all followed views.")]
JobId = Annotated[str, Path(description="The job's id.")]

Found = dict[str, Any]
"""An answer as JSON types: thousands of samples are too many to check one by one."""


def tracks_of(session: Session, job: Job, origin: Origin, site: str | None = None, view: View | None = None) -> Found:
    """The tracks of one site or of all, shaped as :class:`Tracks`.

    Raises
    ------
    Problem
        404 for a site the job does not have, 409 ``not_ready`` while one of the asked sites is not followed yet.
    """
    snapshot = snapshot_of(job)
    if site is not None and site not in _sites(snapshot):
        raise not_found("site in this job")
    triangulation = load(Triangulation, done_stage(session, job, "triangulate"))
    views = [entry for entry in snapshot.views if view in (None, entry)]
    found: Found = {"frame": {"axes": "LPS", "origin": str(origin), "unit": "mm"}, "tracks": [], "rejected": []}
    for stage in stages_of(session, job.id, "monoplane"):
        if site in (None, stage.subject):
            _add_site(found, job, stage, views, origin, snapshot, triangulation)
    for plan in snapshot.rejected:
        if site in (None, plan.site):
            message = " ".join(reason.sentence for reason in plan.reasons)
            found["rejected"] += [_rejected(plan.site, entry, plan.reasons, message) for entry in views]
    return found


def _sites(snapshot: Snapshot) -> set[str]:
    return {plan.site for plan in snapshot.sites} | {plan.site for plan in snapshot.rejected}


def _add_site(
    found: Found, job: Job, stage: StageRow, views: list[View], origin: Origin, snapshot: Snapshot,
    triangulation: Triangulation,
) -> None:  # fmt: skip
    if stage.state == StageState.FAILED:
        message = str((stage.error or {}).get("detail", Reason.PLUGIN_FAILED.sentence))
        found["rejected"] += [_rejected(stage.subject, view, (Reason.PLUGIN_FAILED,), message) for view in views]
        return
    if stage.state != StageState.DONE:
        raise not_ready(job, "monoplane", stage)
    located = next((entry for entry in triangulation.sites if entry.site == stage.subject), None)
    refused = next((entry.reasons for entry in triangulation.rejected if entry.site == stage.subject), ())
    others = map_origin(triangulation)
    for followed in load(SiteTracks, stage).views:
        if followed.view not in views:
            continue
        if followed.track is None or located is None:
            reasons = (followed.refused, *refused) if followed.refused else refused
            found["rejected"].append(_rejected(stage.subject, followed.view, reasons, followed.message))
            continue
        track, camera = followed.track, camera_of(located, followed.view)
        if origin is Origin.REFERENCE:
            mean = None if others is None else np.array(others)
            origins = reference(track, located, snapshot.reference, mean)
        else:
            origins = isocentre(len(track.located))
        for index, (catheter, electrode) in enumerate(track.labels):
            found["tracks"].append(
                {
                    "site": stage.subject,
                    "view": followed.view,
                    "catheter": catheter,
                    "electrode": electrode,
                    "solver": stage.plugin,
                    "samples": [_sample(sample) for sample in samples(track, index, camera, origins)],
                }
            )


def _rejected(site: str, view: View, reasons: tuple[Reason, ...], message: str) -> Found:
    codes = list(dict.fromkeys(str(reason) for reason in reasons))
    return {"site": site, "view": view, "reasons": codes, "message": message}


def _sample(sample: Sample) -> Found:
    x, y, z = (None, None, None) if sample.position_mm is None else sample.position_mm.tolist()
    u, v = (None, None) if sample.pixel_uv is None else sample.pixel_uv.tolist()
    return {
        "frame": sample.frame,
        "x_mm": x,
        "y_mm": y,
        "z_mm": z,
        "along_ray_sd_mm": sample.along_ray_sd_mm,
        "lateral_sd_mm": sample.lateral_sd_mm,
        "covariance_mm2": None if sample.covariance_mm2 is None else sample.covariance_mm2[_UPPER].tolist(),
        "baseline_mm": None if sample.baseline_mm is None else sample.baseline_mm.tolist(),
        "u_px": u,
        "v_px": v,
        "grade": str(sample.grade),
        "reasons": [str(reason) for reason in sample.reasons],
    }


def tracks_csv(found: Found) -> str:
    return csv_text(COLUMNS, _lines(found))


def _lines(found: Found) -> Iterator[list[Any]]:
    for track in found["tracks"]:
        for sample in track["samples"]:
            yield [
                track["site"], track["view"], track["catheter"], track["electrode"], track["solver"], sample["frame"],
                sample["x_mm"], sample["y_mm"], sample["z_mm"], sample["along_ray_sd_mm"], sample["lateral_sd_mm"],
                *(sample["covariance_mm2"] or [None] * 6), *(sample["baseline_mm"] or [None] * 3),
                sample["u_px"], sample["v_px"], sample["grade"], ";".join(sample["reasons"]),
            ]  # fmt: skip
    for refused in found["rejected"]:
        reasons = ";".join(refused["reasons"])
        yield [refused["site"], refused["view"], *[None] * 20, str(Grade.REJECTED), reasons]


def _read(job_id: str, origin: Origin, site: str | None, view: View | None) -> Found:
    with reading() as session:
        return tracks_of(session, job_of(session, job_id), origin, site, view)


@router.get(
    "/v1/jobs/{job_id}/tracks",
    summary="Electrodes followed through one view",
    response_model=Tracks,
    responses={200: {"content": CSV_ENTRY}, **responses(401, 403, 404, 409, 422)},
)
def get_tracks(
    job_id: JobId,
    request: Request,
    caller: Reader,
    site: SiteQuery = None,
    view: ViewQuery = None,
    origin: OriginQuery = Origin.REFERENCE,
) -> Response:
    """Every electrode in every frame of the followed views, as JSON or CSV.

    Origin `reference` subtracts the reference catheter's mean of the same frame, or the site's diastolic one in frames
    where it was not located. Views that could not be followed stand under `rejected` with their reasons. 409
    `not_ready` until the stage `monoplane` of the site (without `site`: of all sites) is done.
    """
    found = _read(job_id, origin, site, view)
    if wants_csv(request):
        return csv_response(tracks_csv(found), "tracks.csv")
    return JSONResponse(found, headers={"Vary": "Accept"})


@router.get(
    "/v1/jobs/{job_id}/tracks.csv",
    summary="Electrodes followed through one view, as CSV",
    response_class=Response,
    responses={200: {"content": CSV_ENTRY}, **responses(401, 403, 404, 409, 422)},
)
def get_tracks_csv(
    job_id: JobId,
    caller: Reader,
    site: SiteQuery = None,
    view: ViewQuery = None,
    origin: OriginQuery = Origin.REFERENCE,
) -> Response:
    """The same as `tracks`, always as CSV."""
    return csv_response(tracks_csv(_read(job_id, origin, site, view)), "tracks.csv")
