"""Everything a job made, in one file."""

from __future__ import annotations

import json
import tempfile
import zipfile
from collections.abc import Iterator
from typing import IO, Annotated, Any

from fastapi import APIRouter, Path
from fastapi.responses import StreamingResponse
from sqlalchemy.orm import Session
from starlette.background import BackgroundTask

from fluoromap.drawing.map_picture import draw_map_views
from fluoromap.drawing.overlay import Look
from fluoromap.drawing.png import encode_png
from fluoromap_service.api.http.file_names import plain_name
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.jobs.finished import job_of, map_of, snapshot_of
from fluoromap_service.api.jobs.job_answers import read_job
from fluoromap_service.api.results.maps import MeshFormat, activation_map, chamber_of, mesh_of
from fluoromap_service.api.results.origins import Origin
from fluoromap_service.api.results.overlays import fusion_of, overlays_of, picture_of
from fluoromap_service.api.results.points import points_csv, points_of
from fluoromap_service.api.results.report import report_page
from fluoromap_service.api.results.tracks import tracks_csv, tracks_of
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import reading
from fluoromap_service.store.files import CHUNK_BYTES
from fluoromap_service.store.models import ENDED_JOB, Job

router = APIRouter(tags=["results"])

_MOMENT = (1980, 1, 1, 0, 0, 0)
"""The date of every entry, so that the same results give the same bytes."""


@router.get(
    "/v1/jobs/{job_id}/archive.zip",
    summary="Everything in one file",
    response_class=StreamingResponse,
    responses={
        200: {
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
            "description": "A zip.",
        },
        **responses(401, 403, 404, 409, 422, 429),
    },
)
def get_archive(job_id: Annotated[str, Path(description="The job's id.")], caller: Reader) -> StreamingResponse:
    """`job.json`, `parameters.json`, `points.csv`, `tracks.csv`, `report.html`, `map.json`, `map.png`, the mesh in all formats
    and an overlay of each view of each site, as far as the job came; coordinates from the reference catheter. 409 until the
    job has ended.
    """
    folder = settings().files_dir / "incoming"
    folder.mkdir(parents=True, exist_ok=True)
    stream = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed when the answer was sent
    try:
        with zipfile.ZipFile(stream, "w") as archive:
            for name, content, compress in _entries(job_id):
                entry = zipfile.ZipInfo(name, _MOMENT)
                entry.compress_type = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
                entry.external_attr = 0o644 << 16
                archive.writestr(entry, content)
        size = stream.tell()
        stream.seek(0)
    except BaseException:
        stream.close()
        raise
    headers = {"Content-Disposition": f'attachment; filename="fluoromap-{job_id}.zip"', "Content-Length": str(size)}
    return StreamingResponse(_chunks(stream), 200, headers, "application/zip", BackgroundTask(stream.close))


def _chunks(stream: IO[bytes]) -> Iterator[bytes]:
    while chunk := stream.read(CHUNK_BYTES):
        yield chunk


def _entries(job_id: str) -> Iterator[tuple[str, bytes, bool]]:
    """Name, content and whether compressing pays, of each file."""
    with reading() as session:
        job = job_of(session, job_id)
        if job.state not in ENDED_JOB:
            raise Problem(409, "not_ready", "The archive is made when the job has ended; follow the job and ask again.")
        yield "job.json", _json(read_job(session, job).model_dump(mode="json")), True
        yield "parameters.json", _json(_parameters(job)), True
        tables = list(_tables(session, job))
    yield from tables
    yield "report.html", report_page(job_id).encode(), True
    yield from _map(job_id)


def _parameters(job: Job) -> dict[str, Any]:
    return snapshot_of(job).model_dump(mode="json", exclude={"runs"})


def _tables(session: Session, job: Job) -> Iterator[tuple[str, bytes, bool]]:
    try:
        yield "points.csv", points_csv(points_of(session, job, Origin.REFERENCE)).encode(), True
        yield "tracks.csv", tracks_csv(tracks_of(session, job, Origin.REFERENCE)).encode(), True
    except Problem as problem:
        if problem.code != "not_ready":
            raise


def _map(job_id: str) -> Iterator[tuple[str, bytes, bool]]:
    try:
        with reading() as session:
            job = job_of(session, job_id)
            outcome, stage = map_of(session, job)
            overlays = [
                (overlay, fusion_of(session, job, overlay.sop_instance_uid, None))
                for overlay in overlays_of(session, job)
            ]
    except Problem as problem:
        if problem.code not in ("not_ready", "no_map"):
            raise
        return
    chamber = chamber_of(outcome)
    yield "map.png", encode_png(draw_map_views(chamber)), False
    yield "map.json", activation_map(outcome, chamber, Origin.REFERENCE).model_dump_json().encode(), True
    for mesh_format in MeshFormat:
        mesh = mesh_of(job_id, outcome, str(stage.result), mesh_format, Origin.REFERENCE)
        yield f"mesh/chamber.{mesh_format}", mesh.path.read_bytes(), True
    taken: set[str] = set()
    for overlay, fusion in overlays:
        name = f"overlays/{plain_name(overlay.site)}-{overlay.view}.png"
        if name in taken:
            name = f"overlays/{plain_name(overlay.site)}-{overlay.view}-{len(taken) + 1}.png"
        taken.add(name)
        try:
            picture = picture_of(job_id, fusion, Look())
        except Problem as problem:
            yield name.removesuffix(".png") + ".txt", f"{problem.detail}\n".encode(), True
            continue
        yield name, picture.path.read_bytes(), False


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=2, ensure_ascii=False).encode()
