"""The de-identified export of a job: its runs and its results without the patient's identity."""

from __future__ import annotations

import dataclasses
import re
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import IO, Annotated

import pydicom
from fastapi import Query
from fastapi.responses import StreamingResponse
from starlette.background import BackgroundTask

from fluoromap_service.api.http.csv_answers import csv_text
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.middleware.download_limit import LARGE_DOWNLOAD
from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.results.points import points_csv, points_of
from fluoromap_service.api.results.result_objects import JobObjects, plan_objects
from fluoromap_service.api.results.tracks import read_entries, tracks_csv
from fluoromap_service.dicom.deidentification.pseudonyms import Dates, Pseudonyms
from fluoromap_service.dicom.deidentification.run_file import deidentify_file
from fluoromap_service.dicom.objects.job_results import ResultOrigin, RunReference
from fluoromap_service.problem import Problem
from fluoromap_service.results.finished import ended_job_of, snapshot_of
from fluoromap_service.results.origins import Origin
from fluoromap_service.store import disk, files, reidentification
from fluoromap_service.store.engine import reading
from fluoromap_service.study.run_files import check_not_deleted
from fluoromap_service.study.snapshot import SiteSnapshot

router = new_router(tags=["results"])

_DATE = (1980, 1, 1, 0, 0, 0)
"""The date of every file in the zip."""
_SUBJECT = r"^[A-Za-z0-9._-]{0,64}$"
_NO_DATE = datetime(1900, 1, 1, tzinfo=UTC)

README = """De-identified export of a fluoromap job
======================================

The DICOM headers are treated by the Basic Application Level Confidentiality Profile of PS3.15.
Dates: {dates}.

The pixels are unchanged. Nobody has looked for text that a system burned into the picture, such as a name: look at every run
before you pass it on. Names of sites are unchanged too; they are in the pictures, in the report and in the tables.

runs/       the runs of the job
results/    the results as DICOM objects
activation-times.csv      the sites with their runs
points.csv, tracks.csv    positions in mm
"""
_SENTENCES = {
    Dates.REMOVE: "removed, or 1900-01-01 where an object needs one",
    Dates.SHIFT: "shifted by one number of days for the whole patient; times of the day are unchanged",
    Dates.KEEP: "unchanged",
}


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """The choices of an export; an empty ``subject`` takes a name from the secret of the installation."""

    dates: Dates = Dates.REMOVE
    subject: str = ""

    def __post_init__(self) -> None:
        if not re.fullmatch(_SUBJECT, self.subject):
            raise Problem(422, "invalid", "The subject is wrong; send at most 64 of the characters A-Z a-z 0-9 . _ -")


@router.get(
    "/v1/jobs/{job_id}/deidentified.zip",
    dependencies=[LARGE_DOWNLOAD],
    summary="Runs and results without the patient's identity",
    response_class=StreamingResponse,
    responses={
        200: {
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
            "description": "A zip.",
        },
        **responses(401, 403, 404, 409, 422, 429),
    },
)
def get_deidentified(
    job_id: JobId,
    caller: Reader,
    dates: Annotated[
        Dates,
        Query(description="`remove` dates, `shift` them by a secret number of days of the patient, or `keep` them."),
    ] = Dates.REMOVE,
    subject: Annotated[
        str,
        Query(
            pattern=_SUBJECT,
            description="New name and ID of the patient; by default a pseudonym that is always the same for the patient.",
        ),
    ] = "",
) -> StreamingResponse:
    """Return the runs and the results of a job, de-identified, in one zip.

    The headers are treated by the Basic Application Level Confidentiality Profile (PS3.15). The pixels are unchanged:
    text that is burned into them stays. The list that leads back from the new UIDs stays in the data folder of the
    service.
    """
    stream = tempfile.TemporaryFile(dir=files.made_incoming_folder())  # noqa: SIM115 - the background task closes it after the answer
    try:
        write_export(job_id, stream, ExportOptions(dates, subject))
        size = stream.tell()
        stream.seek(0)
    except BaseException:
        stream.close()
        raise
    headers = {
        "Content-Disposition": f'attachment; filename="fluoromap-{job_id}-deidentified.zip"',
        "Content-Length": str(size),
    }
    return StreamingResponse(_chunks(stream), 200, headers, "application/zip", BackgroundTask(stream.close))


def write_export(job_id: str, stream: IO[bytes], options: ExportOptions) -> Path:
    """Write the zip of an export.

    Returns
    -------
    Path
        The list that leads back from the new UIDs; it is no part of the zip.

    Raises
    ------
    Problem
        404 when there is no such job; 409 while the job runs, or where somebody deleted one of its runs.
    NoSpace
        When the export would fill the reserve of the disk.
    """
    with reading() as session:
        job = ended_job_of(session, job_id, "export")
        study_id, snapshot = job.study_id, snapshot_of(job)
        runs = {uid: run.sha256 for uid, run in snapshot.runs.items()}
        tables = dict(_tables(job_id))
    planned = _planned(job_id)
    check_not_deleted(runs.values())
    # The runs are copied, and the copies lie in the zip too.
    disk.check_room(2 * sum(files.path_of(sha256).stat().st_size for sha256 in runs.values()))
    pseudonyms = Pseudonyms(
        reidentification.secret(), _patient(next(iter(runs.values()))), options.subject, options.dates
    )
    with files.incoming_files() as folder, zipfile.ZipFile(stream, "w") as archive:
        _add(archive, "README.txt", README.format(dates=_SENTENCES[options.dates]).encode())
        replaced: dict[str, str] = {}
        copies: dict[Path, Path] = {}
        for number, (uid, sha256) in enumerate(runs.items(), start=1):
            source, copy = files.checked_path(sha256), folder / f"{number}.dcm"
            replaced |= run_in_pool(Task.WRITE_DICOM, deidentify_file, source, copy, pseudonyms)
            copies[source] = copy
            _add(archive, f"runs/{pseudonyms.uid(uid)}.dcm", copy)
        if planned is not None:
            origin = _renamed(planned.origin, copies, pseudonyms)
            for each in planned.objects:
                _add(archive, f"results/{each.name}", each.content(origin))
        for name, text in tables.items():
            _add(archive, name, text.encode())
        _add(archive, "activation-times.csv", _activation_times(snapshot.sites, pseudonyms).encode())
    return reidentification.add_replacements(study_id, replaced)


def _patient(sha256: str) -> str:
    """Return the text that names the patient of a run, for hashing only."""
    header = pydicom.dcmread(
        files.checked_path(sha256), stop_before_pixels=True, specific_tags=["PatientID", "StudyInstanceUID"]
    )
    return str(header.get("PatientID") or header.StudyInstanceUID)


def _planned(job_id: str) -> JobObjects | None:
    """Return the DICOM objects of a job; None where nothing could be located."""
    try:
        return plan_objects(job_id)
    except Problem as problem:
        if problem.code not in ("no_map", "not_ready"):
            raise
        return None


def _renamed(origin: ResultOrigin, copies: Mapping[Path, Path], pseudonyms: Pseudonyms) -> ResultOrigin:
    """Return the origin of results that refer to the de-identified runs.

    Their UIDs derive from another id of the job.
    """
    finished = origin.finished + timedelta(days=pseudonyms.shift_days)
    return ResultOrigin(
        pseudonyms.uid(origin.job_id),
        _NO_DATE if pseudonyms.dates is Dates.REMOVE else finished,
        copies[origin.first_run],
        tuple(_renamed_run(run, pseudonyms) for run in origin.other_runs),
    )


def _renamed_run(run: RunReference, pseudonyms: Pseudonyms) -> RunReference:
    return dataclasses.replace(
        run,
        study_instance_uid=pseudonyms.uid(run.study_instance_uid),
        series_instance_uid=pseudonyms.uid(run.series_instance_uid),
        sop_instance_uid=pseudonyms.uid(run.sop_instance_uid),
    )


def _tables(job_id: str) -> Iterator[tuple[str, str]]:
    try:
        with reading() as session:
            job = ended_job_of(session, job_id, "export")
            yield "points.csv", points_csv(points_of(session, job, Origin.REFERENCE))
            yield "tracks.csv", b"".join(tracks_csv(read_entries(session, job, Origin.REFERENCE))).decode()
    except Problem as problem:
        if problem.code != "not_ready":
            raise


def _activation_times(sites: tuple[SiteSnapshot, ...], pseudonyms: Pseudonyms) -> str:
    """Return the table of the sites with their runs, as ``PUT .../activation-times`` takes it."""
    rows = [[site.site, site.lat_ms, pseudonyms.uid(site.view_a), pseudonyms.uid(site.view_b)] for site in sites]
    return csv_text(("site", "lat_ms", "view_a", "view_b"), rows)


def _add(archive: zipfile.ZipFile, name: str, content: bytes | Path) -> None:
    entry = zipfile.ZipInfo(name, _DATE)
    # Noise makes runs hardly smaller, and deflating them takes minutes.
    entry.compress_type = zipfile.ZIP_DEFLATED if isinstance(content, bytes) else zipfile.ZIP_STORED
    entry.external_attr = 0o644 << 16
    with archive.open(entry, "w", force_zip64=True) as member:
        if isinstance(content, bytes):
            member.write(content)
        else:
            with content.open("rb") as stream:
                member.writelines(_chunks(stream))


def _chunks(stream: IO[bytes]) -> Iterator[bytes]:
    while chunk := stream.read(files.CHUNK_BYTES):
        yield chunk
