"""The routes of the tracks: every electrode in 3D in every frame of one view."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import IO, Annotated, Any, Literal

import msgspec
import numpy as np
from fastapi import Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from fluoromap.contracts import Grade, View
from fluoromap.monoplane.track_samples import Sample
from fluoromap.reasons import Reason
from fluoromap_service.api.http.csv_answers import (
    MEDIA_TYPE_UTF8,
    csv_entry,
    csv_headers,
    csv_pieces,
    wants_csv,
)
from fluoromap_service.api.http.middleware.download_limit import LARGE_DOWNLOAD
from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.http.spooled_answers import spooled_answer
from fluoromap_service.api.results.origins import FrameOfReference, OriginQuery, Position, Six
from fluoromap_service.results.dependencies import tracks_table_dependencies
from fluoromap_service.results.finished import job_of
from fluoromap_service.results.origins import Origin, origin_in
from fluoromap_service.results.tracks import RejectedView, tracks_of
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job
from fluoromap_service.store.names import Name
from fluoromap_service.store.renderings import KeptFile, kept_file

router = new_router(tags=["results"])

_UPPER = np.triu_indices(3)


class TrackSample(BaseModel):
    """An electrode in one frame; no position where ``grade`` is rejected."""

    frame: int = Field(description="Counted from 1.")
    x_mm: float | None
    y_mm: float | None
    z_mm: float | None
    along_ray_sd_mm: float | None = Field(description="Standard deviation along this view's ray: the depth.")
    lateral_sd_mm: float | None = Field(description="Standard deviation across the ray, RMS of both directions.")
    covariance_mm2: Six | None = Field(
        description=(
            "xx, xy, xz, yy, yz, zz. With origin `reference`: of the position minus the reference's position in the same frame, "
            "where the solver gives it; otherwise of the position from the isocentre."
        )
    )
    baseline_mm: Position | None = Field(
        description="Plain back-projection at the known depth, for comparison with the position."
    )
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
    """A view without a track, and why."""

    site: str
    view: Literal["a", "b"]
    reasons: list[Reason]
    message: str


class Tracks(BaseModel):
    """The tracks of a job."""

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
                            "message": "This site has no biplane position, and a single view does not show depth.",
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

SiteQuery = Annotated[Name | None, Query(description="Only this site; without it all sites.", examples=["S03"])]
ViewQuery = Annotated[Literal["a", "b"] | None, Query(description="Only this view; without it all tracked views.")]

Entry = tuple[Literal["tracks", "rejected"], dict[str, Any]]
"""One entry of the answer, and the list to which it belongs.

It is JSON values: pydantic would take too long for thousands of samples.
"""


def read_entries(
    session: Session,
    job: Job,
    origin: Origin,
    site: str | None = None,
    view: View | None = None,
    tip_of: str | None = None,
) -> Iterator[Entry]:
    """Return the entries of :class:`Tracks`, one after the other.

    As values all samples of a study take ten times the memory of their text, so a caller takes one entry at a time. With
    ``tip_of``, the name of a catheter, only the tracks of its tip.

    Raises
    ------
    Problem
        404 for a site that the job does not have; 409 ``not_ready`` while the track of one of the sites is not done.
    """
    for found in tracks_of(session, job, origin, site, view, tip_of):
        if isinstance(found, RejectedView):
            codes = list(dict.fromkeys(str(reason) for reason in found.reasons))
            yield (
                "rejected",
                {"site": found.site, "view": found.view, "reasons": codes, "message": found.message},
            )
        else:
            yield (
                "tracks",
                {
                    "site": found.site,
                    "view": found.view,
                    "catheter": found.catheter,
                    "electrode": found.electrode,
                    "solver": found.solver,
                    "samples": [_sample(sample) for sample in found.samples],
                },
            )


def _frame(origin: Origin) -> dict[str, str]:
    return {"axes": "LPS", "origin": str(origin), "unit": "mm"}


def _json_pieces(entries: Iterable[Entry], origin: Origin) -> Iterator[bytes]:
    """Return the text of :class:`Tracks`, in pieces."""
    yield b'{"frame":' + msgspec.json.encode(_frame(origin)) + b',"tracks":['
    comma, rejected = b"", []
    for name, entry in entries:
        if name == "rejected":
            rejected.append(msgspec.json.encode(entry))
            continue
        yield comma + msgspec.json.encode(entry)
        comma = b","
    yield b'],"rejected":[' + b",".join(rejected) + b"]}"


def _sample(sample: Sample) -> dict[str, Any]:
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


def tracks_csv(entries: Iterable[Entry]) -> Iterator[bytes]:
    """Return tracks as CSV in pieces.

    There is one line for each electrode and frame. The rejected views come last.
    """
    return csv_pieces(COLUMNS, _lines(entries))


def _lines(entries: Iterable[Entry]) -> Iterator[list[Any]]:
    rejected = []
    for name, track in entries:
        if name == "rejected":
            rejected.append(track)
            continue
        for sample in track["samples"]:
            yield [
                track["site"], track["view"], track["catheter"], track["electrode"], track["solver"], sample["frame"],
                sample["x_mm"], sample["y_mm"], sample["z_mm"], sample["along_ray_sd_mm"], sample["lateral_sd_mm"],
                *(sample["covariance_mm2"] or [None] * 6), *(sample["baseline_mm"] or [None] * 3),
                sample["u_px"], sample["v_px"], sample["grade"], ";".join(sample["reasons"]),
            ]  # fmt: skip
    for view in rejected:
        yield [view["site"], view["view"], *[None] * 20, str(Grade.REJECTED), ";".join(view["reasons"])]


def _csv_answer(job_id: str, origin: Origin, site: str | None, view: View | None) -> Response:
    with reading() as session:
        pieces = tracks_csv(read_entries(session, job_of(session, job_id), origin, site, view))
        return spooled_answer(pieces, MEDIA_TYPE_UTF8, csv_headers("tracks.csv"))


def _json_answer(job_id: str, origin: Origin, site: str | None, view: View | None) -> Response:
    with reading() as session:
        job = job_of(session, job_id)
        pieces = _json_pieces(read_entries(session, job, origin, site, view), origin_in(job, origin))
        return spooled_answer(pieces, "application/json", {"Vary": "Accept"})


def tracks_table_of(job_id: str, job_version: int) -> KeptFile:
    """Return the kept table of an ended job's tracks.

    It is made when there is none. Its coordinates count from the reference catheter.
    """

    def write(file: IO[bytes]) -> None:
        with reading() as session:
            file.writelines(tracks_csv(read_entries(session, job_of(session, job_id), Origin.REFERENCE)))

    return kept_file(job_id, tracks_table_dependencies(job_id, job_version), write)


@router.get(
    "/v1/jobs/{job_id}/tracks",
    dependencies=[LARGE_DOWNLOAD],
    summary="Electrodes followed through one view",
    response_model=Tracks,
    responses={200: {"content": CSV_ENTRY}, **responses(401, 403, 404, 409, 422, 429)},
)
def get_tracks(
    job_id: JobId,
    request: Request,
    caller: Reader,
    site: SiteQuery = None,
    view: ViewQuery = None,
    origin: OriginQuery = Origin.REFERENCE,
) -> Response:
    """Return every electrode in every frame of the tracked views.

    The format is JSON or CSV. Origin `reference` subtracts the reference catheter's mean of the same frame. Frames that
    do not locate this catheter subtract the site's diastolic mean. `rejected` lists the views without a track, with
    their reasons. The answer is 409 `not_ready` until the stage `monoplane` of the site (without `site`: of all sites)
    is done.
    """
    if wants_csv(request):
        return _csv_answer(job_id, origin, site, view)
    return _json_answer(job_id, origin, site, view)


@router.get(
    "/v1/jobs/{job_id}/tracks.csv",
    dependencies=[LARGE_DOWNLOAD],
    summary="Electrodes followed through one view, as CSV",
    response_class=Response,
    responses={200: {"content": CSV_ENTRY}, **responses(401, 403, 404, 409, 422, 429)},
)
def get_tracks_csv(
    job_id: JobId,
    caller: Reader,
    site: SiteQuery = None,
    view: ViewQuery = None,
    origin: OriginQuery = Origin.REFERENCE,
) -> Response:
    """Return the same tracks as `tracks`, always as CSV."""
    return _csv_answer(job_id, origin, site, view)
