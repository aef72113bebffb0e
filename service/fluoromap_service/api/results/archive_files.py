"""The files of a job's archive."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluoromap.drawing.overlay import Look
from fluoromap_service.api.http.file_names import plain_name
from fluoromap_service.api.http.file_pool import PROCESSES
from fluoromap_service.api.jobs.job_answers import read_job
from fluoromap_service.api.results.maps import activation_map, map_picture_of
from fluoromap_service.api.results.overlays import check_picture, picture_of
from fluoromap_service.api.results.points import points_csv, points_of
from fluoromap_service.api.results.report_page import report_of
from fluoromap_service.api.results.tracks import tracks_table_of
from fluoromap_service.jobs.stage_results import stages_of
from fluoromap_service.problem import Problem
from fluoromap_service.results.finished import ended_job_of, job_of, snapshot_of
from fluoromap_service.results.fusion import Fusion, fusion_of
from fluoromap_service.results.maps import FinishedMap, map_of
from fluoromap_service.results.mesh_files import MeshFormat, mesh_of
from fluoromap_service.results.origins import Origin
from fluoromap_service.results.placement import LocatedView, located_views
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job
from fluoromap_service.store.renderings import KeptFile


@dataclass(frozen=True, slots=True)
class ArchiveFile:
    """One file of the archive: its content, or the path of a kept file.

    ``compress`` is False for content that does not become smaller.
    """

    name: str
    content: bytes | Path
    compress: bool = True


def archive_files(job_id: str) -> Iterator[ArchiveFile]:
    """Return the files of a job's archive, one after the other.

    The pool draws the overlays while the others are made.

    Raises
    ------
    Problem
        Before the first file: 404 when there is no such job; 409 ``not_ready`` while the job runs.
    BrokenFile
        Before the first file: when a stored file that the archive needs is missing or damaged.
    """
    with reading() as session:
        job = ended_job_of(session, job_id, "archive")
        state, parameters, job_version = read_job(session, job).model_dump(mode="json"), _parameters(job), job.version
        tracks = [stage.result for stage in stages_of(session, job_id, "monoplane") if stage.result is not None]
    # An error after the first file could only end the connection.
    for sha256 in tracks:
        files.checked_path(sha256)
    found = _map_and_fusions(job_id)
    for _, fusion in [] if found is None else found[1]:
        check_picture(job_id, fusion, Look())
    yield ArchiveFile("job.json", _json(state))
    yield ArchiveFile("parameters.json", _json(parameters))
    threads = ThreadPoolExecutor(PROCESSES)
    try:
        overlays = [] if found is None else _start_overlays(job_id, found[1], threads)
        yield from _tables(job_id, job_version)
        yield ArchiveFile("report.html", report_of(job_id).path)
        if found is not None:
            yield from _map(job_id, found[0])
        yield from _overlays(overlays)
    finally:
        # A client that went away wants no more pictures.
        threads.shutdown(wait=False, cancel_futures=True)


def _parameters(job: Job) -> dict[str, Any]:
    return snapshot_of(job).model_dump(mode="json", exclude={"runs"})


def _tables(job_id: str, job_version: int) -> Iterator[ArchiveFile]:
    try:
        with reading() as session:
            points = points_csv(points_of(session, job_of(session, job_id), Origin.REFERENCE)).encode()
        yield ArchiveFile("points.csv", points)
        yield ArchiveFile("tracks.csv", tracks_table_of(job_id, job_version).path)
    except Problem as problem:
        if problem.code != "not_ready":
            raise


def _map_and_fusions(job_id: str) -> tuple[FinishedMap, list[tuple[LocatedView, Fusion]]] | None:
    """Return a job's map and the parts of its overlays; None without a map."""
    try:
        with reading() as session:
            job = job_of(session, job_id)
            finished = map_of(session, job)
            return finished, [(view, fusion_of(session, job, view.uid, None)) for view in located_views(session, job)]
    except Problem as problem:
        if problem.code not in ("not_ready", "no_map"):
            raise
    return None


def _map(job_id: str, finished: FinishedMap) -> Iterator[ArchiveFile]:
    yield ArchiveFile("map.png", map_picture_of(job_id, finished).path, compress=False)
    yield ArchiveFile("map.json", activation_map(finished, Origin.REFERENCE).model_dump_json().encode())
    for mesh_format in MeshFormat:
        mesh = mesh_of(job_id, finished, mesh_format, Origin.REFERENCE)
        yield ArchiveFile(f"mesh/chamber.{mesh_format}", mesh.path)


def _start_overlays(
    job_id: str, fusions: Sequence[tuple[LocatedView, Fusion]], threads: ThreadPoolExecutor
) -> list[tuple[str, Future[KeptFile]]]:
    """Let the pool draw the overlays; return the name and the picture of each."""
    names: dict[str, Future[KeptFile]] = {}
    for view, fusion in fusions:
        name = f"overlays/{plain_name(view.site)}-{view.view}"
        if name in names:
            name = f"{name}-{len(names) + 1}"
        names[name] = threads.submit(picture_of, job_id, fusion, Look())
    return list(names.items())


def _overlays(overlays: Sequence[tuple[str, Future[KeptFile]]]) -> Iterator[ArchiveFile]:
    for name, picture in overlays:
        try:
            yield ArchiveFile(f"{name}.png", picture.result().path, compress=False)
        except Problem as problem:
            yield ArchiveFile(f"{name}.txt", f"{problem.detail}\n".encode())


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=2, ensure_ascii=False).encode()
