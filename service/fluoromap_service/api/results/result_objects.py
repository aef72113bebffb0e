"""The DICOM objects of a job, made when somebody first asks for them and then kept in one zip."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import pydicom

from fluoromap.drawing.overlay import Look
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.results.maps import map_picture_of
from fluoromap_service.api.results.overlays import picture_of
from fluoromap_service.dicom.objects.job_results import JobResults, job_objects
from fluoromap_service.dicom.objects.report_site import ReportSite
from fluoromap_service.problem import Problem
from fluoromap_service.results.dependencies import result_object_dependencies
from fluoromap_service.results.finished import ended_job_of, snapshot_of
from fluoromap_service.results.fusion import fusion_of
from fluoromap_service.results.maps import map_of
from fluoromap_service.results.mesh_files import MeshFormat, mesh_of
from fluoromap_service.results.origins import Origin
from fluoromap_service.results.placement import located_views
from fluoromap_service.results.points import point_rows
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Point
from fluoromap_service.store.renderings import KeptFile, kept_rendering

_DATE = (1980, 1, 1, 0, 0, 0)
"""The date of every file in the zip, so that the same results give the same bytes."""


def objects_zip(job_id: str) -> KeptFile:
    """Return the kept zip of the DICOM objects of a job.

    Raises
    ------
    Problem
        404 when there is no such job; 409 while the job runs, or where it has no result to report.
    """
    with reading() as session:
        ended_job_of(session, job_id, "DICOM zip")
    return kept_rendering(job_id, result_object_dependencies(job_id), lambda: _zip(job_id))


def _zip(job_id: str) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in run_in_pool(Task.WRITE_DICOM, job_objects, results_of(job_id)):
            entry = zipfile.ZipInfo(name, _DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return stream.getvalue()


def results_of(job_id: str) -> JobResults:
    """Return the results of a job that become DICOM objects.

    Raises
    ------
    Problem
        409 where the job has no result to report, or somebody deleted one of its runs.
    """
    with reading() as session:
        job = ended_job_of(session, job_id, "DICOM zip")
        snapshot = snapshot_of(job)
        tips = [row for row in point_rows(session, job) if (row.catheter, row.electrode) == (snapshot.mapping, 1)]
        sites = tuple(site for row in tips if (site := _site(row)) is not None)
        if not sites:
            raise Problem(409, "no_map", "No site could be located, so there is nothing to report; see the points.")
        runs = dict.fromkeys(uid for row in tips for uid in (row.view_a, row.view_b) if uid in snapshot.runs)
        finished = datetime.fromtimestamp(int(job.finished or 0), UTC)
        try:
            chamber = map_of(session, job)
            fusions = [fusion_of(session, job, view.uid, None) for view in located_views(session, job)]
        except Problem as problem:
            if problem.code not in ("not_ready", "no_map"):
                raise
            chamber, fusions = None, []
        hashes = [snapshot.runs[uid].sha256 for uid in runs]
    if not all(files.path_of(sha256).exists() for sha256 in hashes):
        raise Problem(409, "run_deleted", "Somebody deleted a run of this job; upload it again and start a new job.")
    return JobResults(
        job_id,
        finished,
        tuple(files.checked_path(sha256) for sha256 in hashes),
        sites,
        None if chamber is None else chamber.chamber.volume_ml,
        tuple(picture_of(job_id, fusion, Look()).path for fusion in fusions),
        None if chamber is None else map_picture_of(job_id, chamber).path,
        None if chamber is None else mesh_of(job_id, chamber, MeshFormat.STL, Origin.REFERENCE).path,
    )


def _site(row: Point) -> ReportSite | None:
    """Return a located tip from the reference catheter; None where it has no position."""
    if row.relative_mm is None or row.relative_covariance_mm2 is None:
        return None
    xx, xy, xz, yy, yz, zz = row.relative_covariance_mm2
    covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    x, y, z = row.relative_mm
    return ReportSite(row.site, (x, y, z), float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])), row.lat_ms)


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
        As ``objects_zip``.
    """
    with zipfile.ZipFile(io.BytesIO(objects_zip(job_id).path.read_bytes())) as archive:
        return [OutgoingObject.of_file(name, archive.read(name)) for name in archive.namelist()]
