"""The stored instances as DICOMweb shows them: runs and results, their place in study and series, and their headers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import msgspec
from pydicom.uid import ExplicitVRLittleEndian
from sqlalchemy import select

from fluoromap_service.api.dicomweb.display import Display, render_result, render_run, result_frame_bytes
from fluoromap_service.api.dicomweb.indexing import Scope, index_results, index_runs
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.results.result_objects import object_file, plan_objects
from fluoromap_service.dicom import InstanceFacts
from fluoromap_service.dicom.frames import frame_bytes
from fluoromap_service.dicom.indexed_header import metadata_of
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import DicomObject, Instance, Job, JobState, StudyInstance

Json = dict[str, Any]

_PLACE = (DicomObject.study_uid, DicomObject.series_uid, DicomObject.uid)


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
    def id(self) -> int:
        """Id of the row in the index of searches."""

    @property
    def header(self) -> Json:
        """The header in the DICOM JSON model, without long attributes."""

    def metadata(self, header: str, is_whole: bool) -> bytes:
        """Return the whole header in the DICOM JSON model as UTF-8.

        ``header`` is that of the index, and ``is_whole`` whether it has all attributes.
        """

    @property
    def transfer_syntax(self) -> str:
        """UID of the file's encoding."""

    @property
    def frames(self) -> int:
        """Number of frames; 0 for an object without pictures."""

    def make_file(self) -> None:
        """Make the file when it does not exist yet, and check it.

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
    """A stored run; ``id`` is that of its row in the index of searches."""

    id: int
    study_uid: str
    series_uid: str
    uid: str
    sha256: str
    facts: InstanceFacts

    @property
    def header(self) -> Json:
        """The header in the DICOM JSON model."""
        return header_of(self.id)

    def metadata(self, header: str, is_whole: bool) -> bytes:
        """Return the header in the DICOM JSON model as UTF-8."""
        # Also where the index has the whole header: nobody may take a damaged file for a whole one.
        path = self._path
        # A hostile header can take any time, so another process reads it.
        return header.encode() if is_whole else run_in_pool(Task.READ_FILE, metadata_of, path)

    @property
    def transfer_syntax(self) -> str:
        """UID of the file's encoding."""
        return self.facts.transfer_syntax

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.facts.frames

    def make_file(self) -> None:
        """Check the file that somebody sent."""
        files.checked_path(self.sha256)

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

    id: int
    study_uid: str
    series_uid: str
    uid: str
    job_id: str
    name: str

    @property
    def header(self) -> Json:
        """The header in the DICOM JSON model."""
        return header_of(self.id)

    def metadata(self, header: str, is_whole: bool) -> bytes:
        """Return the header in the DICOM JSON model as UTF-8."""
        return header.encode() if is_whole else run_in_pool(Task.READ_FILE, metadata_of, self._path)

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


def _chunks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as stream:
        yield from iter(lambda: stream.read(files.CHUNK_BYTES), b"")


def header_of(object_id: int) -> Json:
    """Return the header of an object in the DICOM JSON model, from the index of searches."""
    with reading() as session:
        header = session.scalar(select(DicomObject.header).where(DicomObject.id == object_id))
    answer: Json = msgspec.json.decode(header or "{}")
    return answer


def metadata_of_all(instances: list[StoredInstance]) -> list[bytes]:
    """Return the whole headers of instances in the DICOM JSON model as UTF-8."""
    found = []
    for each in instances:
        with reading() as session:
            query = select(DicomObject.header, DicomObject.is_whole).where(DicomObject.id == each.id)
            row = session.execute(query).first()
        # A request may delete an object at any moment.
        if row is not None:
            found.append(each.metadata(row.header, row.is_whole))
    return found


def _jobs_over(study_uid: str) -> list[str]:
    """Return the jobs over a DICOM study that succeeded."""
    query = (
        select(Job.id)
        .join(StudyInstance, StudyInstance.study_id == Job.study_id)
        .join(Instance, Instance.sop_instance_uid == StudyInstance.sop_instance_uid)
        .where(Job.state == JobState.SUCCEEDED, Instance.study_instance_uid == study_uid)
        .distinct()
    )
    with reading() as session:
        return list(session.scalars(query))


def existing(study_uid: str, series_uid: str | None = None, uid: str | None = None) -> list[StoredInstance]:
    """Return the stored instances of a resource in the order of their UIDs.

    Raises
    ------
    Problem
        404 when there is none.
    BrokenFile
        When there may be one, and damage hides it: a job's results are not listed while a run that they need is damaged.
    """
    index_runs(Scope(*(None if wanted is None else [wanted] for wanted in (study_uid, series_uid, uid))))
    found = _stored(study_uid, series_uid, uid)
    # Results have their own series, so a series of runs needs none.
    if series_uid is None or not found:
        index_results(study_uid)
        found = _stored(study_uid, series_uid, uid)
    if not found:
        for job_id in _jobs_over(study_uid):
            with suppress(Problem):
                plan_objects(job_id)
        raise not_found("DICOM study, series or instance")
    return found


def _stored(study_uid: str, series_uid: str | None, uid: str | None) -> list[StoredInstance]:
    """Return the indexed instances of a resource in the order of their UIDs."""
    query = (
        select(DicomObject.id, *_PLACE, DicomObject.job_id, DicomObject.name, Instance.sha256, Instance.facts)
        .outerjoin(Instance, Instance.sop_instance_uid == DicomObject.run)
        .order_by(*_PLACE)
    )
    for column, wanted in zip(_PLACE, (study_uid, series_uid, uid), strict=True):
        if wanted is not None:
            query = query.where(column == wanted)
    with reading() as session:
        rows = session.execute(query).all()
    return [
        StoredRun(row.id, row.study_uid, row.series_uid, row.uid, row.sha256, InstanceFacts.from_json(row.facts))
        if row.facts is not None
        else StoredResult(row.id, row.study_uid, row.series_uid, row.uid, row.job_id, row.name)
        for row in rows
    ]
