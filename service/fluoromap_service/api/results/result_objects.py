"""The DICOM objects of a job: planned from its results, made when somebody asks for them, and kept one by one."""

from __future__ import annotations

import io
import threading
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pydicom

from fluoromap.drawing.map_picture import map_picture_size
from fluoromap.drawing.overlay import Look
from fluoromap_service.api.http.file_pool import PROCESSES, Task, run_in_pool
from fluoromap_service.api.results.maps import map_picture_of
from fluoromap_service.api.results.overlays import picture_of
from fluoromap_service.dicom import InstanceFacts
from fluoromap_service.dicom.objects.identity import result_uid
from fluoromap_service.dicom.objects.job_results import (
    ResultOrigin,
    RunReference,
    pictures_object,
    report_object,
    surface_object,
)
from fluoromap_service.dicom.objects.pictures import PictureSeries
from fluoromap_service.dicom.objects.report_site import ReportSite
from fluoromap_service.problem import Problem
from fluoromap_service.results.dependencies import result_object_dependencies
from fluoromap_service.results.finished import ended_job_of, job_of, snapshot_of
from fluoromap_service.results.fusion import fusion_of
from fluoromap_service.results.maps import FinishedMap, map_of
from fluoromap_service.results.mesh_files import MeshFormat, mesh_of
from fluoromap_service.results.origins import Origin, origin_in
from fluoromap_service.results.placement import located_views
from fluoromap_service.results.points import point_rows
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Point
from fluoromap_service.store.renderings import KeptFile, find_rendering, kept_rendering
from fluoromap_service.study.run_files import check_not_deleted
from fluoromap_service.study.snapshot import RunSnapshot, Snapshot

REPORT_NAME = "report.dcm"
ZIP_NAME = "dicom.zip"
_DATE = (1980, 1, 1, 0, 0, 0)
"""The date of every file in the zip, so that the same results give the same bytes."""
_LEVEL = 1
"""Compression of the zip: a higher level takes several times as long and saves a fifth."""
_locks = tuple(threading.Lock() for _ in range(16))
"""Locks for the objects that are being made; an object always has the same one."""


@dataclass(frozen=True, eq=False)
class ResultObject:
    """A DICOM object of a job that may not exist yet.

    name : of its file. content : makes the file, with the runs and UIDs of an origin. series : its pictures; None for an
    object without pictures.
    """

    name: str
    content: Callable[[ResultOrigin], bytes]
    series: PictureSeries | None = None


@dataclass(frozen=True, eq=False)
class JobObjects:
    """The DICOM objects of a job."""

    origin: ResultOrigin
    objects: tuple[ResultObject, ...]

    def names(self) -> dict[str, str]:
        """Return the name of each object by its SOP Instance UID.

        The service knows the UIDs before it makes the objects.
        """
        return {result_uid(self.origin.job_id, each.name.removesuffix(".dcm")): each.name for each in self.objects}


def plan_objects(job_id: str) -> JobObjects:
    """Return the DICOM objects of a job without making any.

    Raises
    ------
    Problem
        404 when there is no such job; 409 while it runs, where it has no result to report, or where somebody deleted one of
        its runs.
    """
    with reading() as session:
        job = ended_job_of(session, job_id, "DICOM zip")
        snapshot = snapshot_of(job)
        tips = [row for row in point_rows(session, job) if (row.catheter, row.electrode) == (snapshot.mapping, 1)]
        counted_from = origin_in(job, Origin.REFERENCE)
        sites = tuple(site for row in tips if (site := _site(row, counted_from)) is not None)
        if not sites:
            raise Problem(409, "no_map", "No site could be located, so there is nothing to report; see the points.")
        try:
            finished = map_of(session, job)
            shown = tuple(view.uid for view in located_views(session, job))
        except Problem as problem:
            if problem.code not in ("not_ready", "no_map"):
                raise
            finished, shown = None, ()
        ended = datetime.fromtimestamp(int(job.finished or 0), UTC)
    named = dict.fromkeys(uid for row in tips for uid in (row.view_a, row.view_b) if uid in snapshot.runs)
    runs = [snapshot.runs[uid] for uid in named]
    check_not_deleted(run.sha256 for run in runs)
    origin = ResultOrigin(
        job_id, ended, files.checked_path(runs[0].sha256), tuple(_reference(run) for run in runs[1:])
    )  # fmt: skip
    volume_ml = None if finished is None else finished.chamber.volume_ml
    report = ResultObject(
        REPORT_NAME, lambda origin: run_in_pool(Task.WRITE_DICOM, report_object, origin, sites, volume_ml)
    )  # fmt: skip
    drawn = () if finished is None else (*_overlays(job_id, snapshot, shown), *_map(job_id, finished))
    return JobObjects(origin, (report, *drawn))


def _site(row: Point, origin: Origin) -> ReportSite | None:
    """Return a located tip from an origin; None where it has no position."""
    position_mm, covariance_mm2 = row.position_mm, row.covariance_mm2
    if origin is Origin.REFERENCE:
        position_mm, covariance_mm2 = row.relative_mm, row.relative_covariance_mm2
    if position_mm is None or covariance_mm2 is None:
        return None
    xx, xy, xz, yy, yz, zz = covariance_mm2
    covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    x, y, z = position_mm
    return ReportSite(row.site, (x, y, z), float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])), row.lat_ms)


def _reference(run: RunSnapshot) -> RunReference:
    facts = InstanceFacts.from_json(run.facts)
    return RunReference(
        facts.sop_class_uid, facts.study_instance_uid, facts.series_instance_uid, facts.sop_instance_uid
    )  # fmt: skip


def _overlays(job_id: str, snapshot: Snapshot, shown: Sequence[str]) -> Iterator[ResultObject]:
    """Yield an object for the overlays of each size.

    All frames of an object have one size.
    """
    sizes: dict[tuple[int, int], list[str]] = {}
    for uid in shown:
        gantry = snapshot.runs[uid].gantry
        sizes.setdefault((gantry.rows, gantry.columns), []).append(uid)
    for number, ((rows, columns), uids) in enumerate(sizes.items(), start=1):
        series = PictureSeries(
            f"overlays-{number}", 9010 + number, "Activation map drawn into fluoroscopy frames", len(uids), rows, columns
        )  # fmt: skip
        yield _pictures(series, partial(_draw_overlays, job_id, tuple(uids)))


def _draw_overlays(job_id: str, uids: Sequence[str]) -> tuple[Path, ...]:
    with reading() as session:
        job = job_of(session, job_id)
        fusions = [fusion_of(session, job, uid, None) for uid in uids]
    with ThreadPoolExecutor(PROCESSES) as threads:
        return tuple(kept.path for kept in threads.map(lambda fusion: picture_of(job_id, fusion, Look()), fusions))


def _map(job_id: str, finished: FinishedMap) -> Iterator[ResultObject]:
    rows, columns = map_picture_size()
    series = PictureSeries("map", 9010, "Activation map of the chamber from six sides", 1, rows, columns)
    yield _pictures(series, lambda: (map_picture_of(job_id, finished).path,))

    def surface(origin: ResultOrigin) -> bytes:
        stl = mesh_of(job_id, finished, MeshFormat.STL, Origin.REFERENCE).path
        return run_in_pool(Task.WRITE_DICOM, surface_object, origin, stl)

    yield ResultObject("chamber.dcm", surface)


def _pictures(series: PictureSeries, draw: Callable[[], tuple[Path, ...]]) -> ResultObject:
    return ResultObject(
        f"{series.name}.dcm",
        lambda origin: run_in_pool(Task.WRITE_DICOM, pictures_object, origin, series, draw()),
        series,
    )


def find_object(job_id: str, name: str) -> KeptFile | None:
    """Return the kept file of a DICOM object; None when there is none."""
    return find_rendering(job_id, result_object_dependencies(job_id, name))


def object_file(job_id: str, name: str) -> KeptFile:
    """Return the kept file of a DICOM object; make it when there is none.

    Raises
    ------
    Problem
        As :func:`plan_objects`.
    """
    kept = find_object(job_id, name)
    if kept is not None:
        return kept
    planned = plan_objects(job_id)
    return made_object(planned.origin, next(each for each in planned.objects if each.name == name))


def made_object(origin: ResultOrigin, planned: ResultObject) -> KeptFile:
    """Return the kept file of a planned object; make it when there is none."""
    dependencies = result_object_dependencies(origin.job_id, planned.name)
    # A viewer asks for all frames of an object at once: the first request makes it, and the others wait.
    with _locks[hash((origin.job_id, planned.name)) % len(_locks)]:
        return kept_rendering(origin.job_id, dependencies, lambda: planned.content(origin))


def objects_zip(job_id: str) -> KeptFile:
    """Return the kept zip of the DICOM objects of a job.

    Raises
    ------
    Problem
        As :func:`plan_objects`.
    """
    with reading() as session:
        ended_job_of(session, job_id, "DICOM zip")
    return kept_rendering(job_id, result_object_dependencies(job_id, ZIP_NAME), lambda: _zip(job_id))


def _zip(job_id: str) -> bytes:
    planned = plan_objects(job_id)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for each in planned.objects:
            entry = zipfile.ZipInfo(each.name, _DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, made_object(planned.origin, each).path.read_bytes(), compresslevel=_LEVEL)
    return stream.getvalue()


@dataclass(frozen=True, slots=True)
class OutgoingObject:
    """A DICOM file with the UIDs by which a peer knows it."""

    name: str
    content: bytes
    sop_class_uid: str
    study_instance_uid: str
    series_instance_uid: str
    sop_instance_uid: str

    @classmethod
    def of_file(cls, name: str, content: bytes) -> OutgoingObject:
        """Read the UIDs of a DICOM file."""
        keywords = ["SOPClassUID", "StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID"]
        header = pydicom.dcmread(io.BytesIO(content), stop_before_pixels=True, specific_tags=list(keywords))
        return cls(name, content, *(str(header[keyword].value) for keyword in keywords))


def delivery_objects(job_id: str) -> list[OutgoingObject]:
    """Return the DICOM objects of a job in the order of sending.

    Raises
    ------
    Problem
        As :func:`plan_objects`.
    """
    planned = plan_objects(job_id)
    return [
        OutgoingObject.of_file(each.name, made_object(planned.origin, each).path.read_bytes())
        for each in planned.objects
    ]
