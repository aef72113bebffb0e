"""The stored instances as DICOMweb shows them: runs and results, their place in study and series, and their headers."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pydicom.uid import ExplicitVRLittleEndian
from sqlalchemy import select

from fluoromap_service.api.dicomweb.display import Display, render_result, render_run, result_frame_bytes
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.results.result_objects import (
    REPORT_NAME,
    JobObjects,
    find_object,
    made_object,
    object_file,
    plan_objects,
)
from fluoromap_service.dicom import InstanceFacts
from fluoromap_service.dicom.frames import frame_bytes
from fluoromap_service.dicom.json_model import header_json
from fluoromap_service.dicom.objects.job_results import picture_headers
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Instance, Job, JobState, StudyInstance

Json = dict[str, Any]


class _Remembered:
    """The headers that were read last, by the hash of their file or the id of their job; ``most`` limits their number."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._headers: OrderedDict[str, Json] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: str, read: Callable[[], Json]) -> Json:
        """Return what is remembered under a key; read it when there is nothing."""
        with self._lock:
            if key in self._headers:
                self._headers.move_to_end(key)
                return self._headers[key]
        header = read()
        with self._lock:
            self._headers[key] = header
            while len(self._headers) > self._most:
                self._headers.popitem(last=False)
        return header


_headers_of_runs = _Remembered(2000)
_headers_of_jobs = _Remembered(500)
"""The headers of all results of a job, by the names of the objects."""


class StoredInstance(Protocol):
    """A run that somebody sent, or a result of a job."""

    @property
    def study_uid(self) -> str:
        """Study Instance UID."""

    @property
    def series_uid(self) -> str:
        """Series Instance UID."""

    @property
    def uid(self) -> str:
        """SOP Instance UID."""

    @property
    def header(self) -> Json:
        """The header in the DICOM JSON model; the content of a file never changes, so it is read once."""

    @property
    def transfer_syntax(self) -> str:
        """UID of the file's encoding."""

    @property
    def frames(self) -> int:
        """Number of frames; 0 for an object without pictures."""

    def make_file(self) -> None:
        """Make the file when it does not exist yet.

        A fault then comes before the first byte of an answer.
        """

    def chunks(self) -> Iterator[bytes]:
        """Return the content of the file, piece by piece."""

    def frame(self, index: int) -> bytes:
        """Return the uncompressed pixels of a frame, little endian.

        ``index`` counts from 0.
        """

    def rendered(self, index: int, display: Display) -> bytes:
        """Return a frame as a picture file.

        ``index`` counts from 0.
        """


@dataclass(frozen=True, slots=True)
class StoredRun:
    """A stored run."""

    study_uid: str
    series_uid: str
    uid: str
    sha256: str
    facts: InstanceFacts

    @property
    def header(self) -> Json:
        """The header in the DICOM JSON model."""
        # A hostile header can take any time, so another process reads it.
        return _headers_of_runs.get(self.sha256, lambda: run_in_pool(Task.READ_FILE, header_json, self._path))

    @property
    def transfer_syntax(self) -> str:
        """UID of the file's encoding."""
        return self.facts.transfer_syntax

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.facts.frames

    def make_file(self) -> None:
        """Do nothing: somebody sent the file."""

    def chunks(self) -> Iterator[bytes]:
        """Return the content of the file, piece by piece."""
        return _chunks(self._path)

    def frame(self, index: int) -> bytes:
        """Return the uncompressed pixels of a frame."""
        return run_in_pool(Task.DRAW_PICTURE, frame_bytes, self._path, self.facts, index)

    def rendered(self, index: int, display: Display) -> bytes:
        """Return a frame as a picture file."""
        inverted = self.header.get("00280004", {}).get("Value") == ["MONOCHROME1"]
        return run_in_pool(Task.DRAW_PICTURE, render_run, self._path, self.facts, inverted, index, display)

    @property
    def _path(self) -> Path:
        return files.checked_path(self.sha256)


@dataclass(frozen=True, slots=True)
class StoredResult:
    """A DICOM object of a job. Its header is known before the object is made."""

    job_id: str
    name: str
    header: Json

    @property
    def study_uid(self) -> str:
        """Study Instance UID."""
        return self._value("0020000D")

    @property
    def series_uid(self) -> str:
        """Series Instance UID."""
        return self._value("0020000E")

    @property
    def uid(self) -> str:
        """SOP Instance UID."""
        return self._value("00080018")

    @property
    def transfer_syntax(self) -> str:
        """UID of the file's encoding; all results have the same."""
        return ExplicitVRLittleEndian

    @property
    def frames(self) -> int:
        """Number of frames; 0 for a report or a surface."""
        return int(self.header.get("00280008", {"Value": [0]})["Value"][0])

    def make_file(self) -> None:
        """Make the file when it does not exist yet."""
        object_file(self.job_id, self.name)

    def chunks(self) -> Iterator[bytes]:
        """Return the content of the file, piece by piece."""
        return _chunks(self._path)

    def frame(self, index: int) -> bytes:
        """Return the uncompressed pixels of a frame."""
        return run_in_pool(Task.DRAW_PICTURE, result_frame_bytes, self._path, index)

    def rendered(self, index: int, display: Display) -> bytes:
        """Return a frame as a picture file."""
        return run_in_pool(Task.DRAW_PICTURE, render_result, self._path, index, display)

    @property
    def _path(self) -> Path:
        return object_file(self.job_id, self.name).path

    def _value(self, tag: str) -> str:
        return str(self.header[tag]["Value"][0])


def _chunks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as stream:
        yield from iter(lambda: stream.read(files.CHUNK_BYTES), b"")


def instances_of(
    study_uid: str | None = None, series_uid: str | None = None, uid: str | None = None
) -> list[StoredInstance]:
    """Return the stored instances in the order of their UIDs.

    Each argument limits them to a DICOM study, to a series, or to one UID. Without ``study_uid`` the list has the results only
    of jobs whose DICOM study somebody has asked for.
    """
    query = select(Instance)
    if study_uid is not None:
        query = query.where(Instance.study_instance_uid == study_uid)
    if series_uid is not None:
        query = query.where(Instance.series_instance_uid == series_uid)
    if uid is not None:
        query = query.where(Instance.sop_instance_uid == uid)
    with reading() as session:
        runs: list[StoredInstance] = [
            StoredRun(
                row.study_instance_uid,
                row.series_instance_uid,
                row.sop_instance_uid,
                row.sha256,
                InstanceFacts.from_json(row.facts),
            )
            for row in session.scalars(query)
        ]
    # Results have their own series, so a series of runs needs none.
    results = [] if series_uid is not None and runs else _results(study_uid)
    found = [
        result
        for result in results
        if study_uid in (None, result.study_uid)
        and series_uid in (None, result.series_uid)
        and uid in (None, result.uid)
    ]
    return sorted([*runs, *found], key=lambda each: (each.study_uid, each.series_uid, each.uid))


def _results(study_uid: str | None) -> Iterator[StoredResult]:
    """Yield the DICOM objects of the jobs over a DICOM study.

    Without ``study_uid`` these are the objects of all jobs whose report exists.
    """
    query = (
        select(Job.id)
        .join(StudyInstance, StudyInstance.study_id == Job.study_id)
        .join(Instance, Instance.sop_instance_uid == StudyInstance.sop_instance_uid)
        .where(Job.state == JobState.SUCCEEDED)
        .distinct()
    )
    if study_uid is not None:
        query = query.where(Instance.study_instance_uid == study_uid)
    with reading() as session:
        jobs = list(session.scalars(query))
    for job_id in jobs:
        if study_uid is not None or find_object(job_id, REPORT_NAME) is not None:
            for name, header in _headers_of_results(job_id).items():
                yield StoredResult(job_id, name, header)


def _headers_of_results(job_id: str) -> dict[str, Json]:
    """Return the headers of the DICOM objects of a job by name.

    It draws no picture. Empty for a job without results, or whose runs are damaged: the other instances of the study are
    shown nevertheless.
    """
    try:
        planned = plan_objects(job_id)
        return _headers_of_jobs.get(job_id, lambda: _planned_headers(planned))
    except files.BrokenFile:
        return {}
    except Problem as problem:
        if problem.status in (429, 503):
            raise
        return {}


def _planned_headers(planned: JobObjects) -> dict[str, Json]:
    job_id = planned.origin.job_id
    kept = {each.name: find_object(job_id, each.name) for each in planned.objects}
    drawn_later = [each for each in planned.objects if kept[each.name] is None and each.series is not None]
    series = tuple(each.series for each in drawn_later if each.series is not None)
    later = run_in_pool(Task.WRITE_DICOM, picture_headers, planned.origin, series) if series else []
    headers = {each.name: header for each, header in zip(drawn_later, later, strict=True)}
    return {
        each.name: headers.get(each.name) or header_json(made_object(planned.origin, each).path)
        for each in planned.objects
    }


def existing(study_uid: str, series_uid: str | None = None, uid: str | None = None) -> list[StoredInstance]:
    """Return the stored instances of a resource.

    Raises
    ------
    Problem
        404 when there is none.
    """
    found = instances_of(study_uid, series_uid, uid)
    if not found:
        raise not_found("DICOM study, series or instance")
    return found
