"""The files of a job's archive."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

from fluoromap.drawing.map_picture import draw_map_views
from fluoromap.drawing.overlay import Look
from fluoromap.drawing.png import encode_png
from fluoromap_service.api.http.file_names import plain_name
from fluoromap_service.api.jobs.job_answers import read_job
from fluoromap_service.api.results.maps import activation_map
from fluoromap_service.api.results.overlays import picture_of
from fluoromap_service.api.results.points import points_csv, points_of
from fluoromap_service.api.results.report_page import report_page
from fluoromap_service.api.results.tracks import read_tracks, tracks_csv
from fluoromap_service.problem import Problem
from fluoromap_service.results.finished import ended_job_of, job_of, snapshot_of
from fluoromap_service.results.fusion import Fusion, fusion_of
from fluoromap_service.results.maps import map_of
from fluoromap_service.results.mesh_files import MeshFormat, mesh_of
from fluoromap_service.results.origins import Origin
from fluoromap_service.results.placement import LocatedView, located_views
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job


@dataclass(frozen=True, slots=True)
class ArchiveFile:
    """One file of the archive; ``compress`` is False for content that does not become smaller."""

    name: str
    content: bytes
    compress: bool = True


def archive_files(job_id: str) -> Iterator[ArchiveFile]:
    """Return the files of a job's archive, one after the other.

    Raises
    ------
    Problem
        404 when there is no such job; 409 ``not_ready`` while the job runs.
    """
    with reading() as session:
        job = ended_job_of(session, job_id, "archive")
        yield ArchiveFile("job.json", _json(read_job(session, job).model_dump(mode="json")))
        yield ArchiveFile("parameters.json", _json(_parameters(job)))
        tables = list(_tables(session, job))
    yield from tables
    yield ArchiveFile("report.html", report_page(job_id).encode())
    yield from _map(job_id)


def _parameters(job: Job) -> dict[str, Any]:
    return snapshot_of(job).model_dump(mode="json", exclude={"runs"})


def _tables(session: Session, job: Job) -> Iterator[ArchiveFile]:
    try:
        yield ArchiveFile("points.csv", points_csv(points_of(session, job, Origin.REFERENCE)).encode())
        yield ArchiveFile("tracks.csv", tracks_csv(read_tracks(session, job, Origin.REFERENCE)).encode())
    except Problem as problem:
        if problem.code != "not_ready":
            raise


def _map(job_id: str) -> Iterator[ArchiveFile]:
    try:
        with reading() as session:
            job = job_of(session, job_id)
            finished = map_of(session, job)
            overlays = [(view, fusion_of(session, job, view.uid, None)) for view in located_views(session, job)]
    except Problem as problem:
        if problem.code not in ("not_ready", "no_map"):
            raise
        return
    yield ArchiveFile(
        "map.png", encode_png(draw_map_views(finished.chamber, simulated=finished.simulated)), compress=False
    )
    yield ArchiveFile("map.json", activation_map(finished, Origin.REFERENCE).model_dump_json().encode())
    for mesh_format in MeshFormat:
        mesh = mesh_of(job_id, finished, mesh_format, Origin.REFERENCE)
        yield ArchiveFile(f"mesh/chamber.{mesh_format}", mesh.path.read_bytes())
    yield from _overlays(job_id, overlays)


def _overlays(job_id: str, overlays: list[tuple[LocatedView, Fusion]]) -> Iterator[ArchiveFile]:
    used: set[str] = set()
    for view, fusion in overlays:
        name = f"overlays/{plain_name(view.site)}-{view.view}"
        if name in used:
            name = f"{name}-{len(used) + 1}"
        used.add(name)
        try:
            picture = picture_of(job_id, fusion, Look())
        except Problem as problem:
            yield ArchiveFile(f"{name}.txt", f"{problem.detail}\n".encode())
            continue
        yield ArchiveFile(f"{name}.png", picture.path.read_bytes(), compress=False)


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=2, ensure_ascii=False).encode()
