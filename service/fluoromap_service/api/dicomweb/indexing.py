"""The index of searches, filled with what it lacks: runs of an earlier version, and the results of jobs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import structlog
from sqlalchemy import Select, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.results.result_objects import JobObjects, find_object, made_object, plan_objects
from fluoromap_service.dicom import InstanceFacts
from fluoromap_service.dicom.indexed_header import IndexedHeader, indexed_facts, read_indexed
from fluoromap_service.dicom.objects.job_results import picture_headers
from fluoromap_service.problem import Problem
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import DicomObject, Instance, Job, JobState, StudyInstance
from fluoromap_service.study import dicom_index

BATCH = 50
"""Runs that are indexed between two looks at the database."""
BACKGROUND_SECONDS = 5.0
"""Longest work of one call in the background."""
LONGEST_WAIT_SECONDS = 10.0
"""Longest time for which a search waits for the index."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Scope:
    """The runs that a request is about: those of these UIDs; None means any."""

    study_uids: list[str] | None = None
    series_uids: list[str] | None = None
    uids: list[str] | None = None

    def missing(self) -> Select[str]:
        """Return the query for the runs of the scope that the index lacks."""
        query = select(Instance.sop_instance_uid).where(Instance.is_indexed.is_(False))
        for column, wanted in (
            (Instance.study_instance_uid, self.study_uids),
            (Instance.series_instance_uid, self.series_uids),
            (Instance.sop_instance_uid, self.uids),
        ):
            if wanted is not None:
                query = query.where(column.in_(wanted))
        return query.order_by(Instance.sop_instance_uid).limit(BATCH)


def index_some_runs() -> None:
    """Index runs that an earlier version stored, for a few seconds.

    Any process may call it at any time.
    """
    _index_until(Scope(), time.monotonic() + BACKGROUND_SECONDS)


def index_runs(scope: Scope) -> None:
    """Index all runs of a scope, so that a search is right.

    Raises
    ------
    Problem
        503 ``indexing`` when it takes too long.
    """
    if not _index_until(scope, time.monotonic() + LONGEST_WAIT_SECONDS):
        raise Problem(
            503,
            "indexing",
            "The service still indexes runs that an earlier version stored; send the search again.",
            headers={"Retry-After": "30"},
        )


def _index_until(scope: Scope, end: float) -> bool:
    """Index the runs of a scope and return whether none is left."""
    while True:
        with reading() as session:
            missing = list(session.scalars(scope.missing()))
        if not missing:
            return True
        for uid in missing:
            if time.monotonic() > end:
                return False
            _index_run(uid)


def _index_run(uid: str) -> None:
    with reading() as session:
        run = session.get(Instance, uid)
    if run is None:
        return
    facts = InstanceFacts.from_json(run.facts)
    header = _header_of(run.sha256, facts)
    with writing() as session:
        files.lock(session)
        # Somebody may have deleted the run meanwhile, or another process may have indexed it.
        if session.scalar(
            select(Instance.sop_instance_uid).where(Instance.sop_instance_uid == uid, Instance.is_indexed.is_(False))
        ):
            dicom_index.put_run(session, facts, header)


def _header_of(sha256: str, facts: InstanceFacts) -> IndexedHeader:
    """Return the header of a run for the index.

    A file that cannot be read leaves what the facts have.
    """
    try:
        # A hostile header can take any time, so another process reads it.
        return run_in_pool(Task.READ_FILE, read_indexed, files.checked_path(sha256))
    except (files.BrokenFile, OSError):
        return indexed_facts(facts)
    except Problem as problem:
        if problem.status in (429, 503):
            raise
        return indexed_facts(facts)


def index_results(study_uid: str) -> int:
    """Index the results of the jobs over a DICOM study.

    Return of how many jobs they cannot be listed.
    It draws no picture. A job without results has none to list. The results of a job that cannot be listed change nothing
    about the other instances of the study.
    """
    query = (
        select(Job.id)
        .join(StudyInstance, StudyInstance.study_id == Job.study_id)
        .join(Instance, Instance.sop_instance_uid == StudyInstance.sop_instance_uid)
        .where(Job.state == JobState.SUCCEEDED, Instance.study_instance_uid == study_uid)
        .where(~select(DicomObject.id).where(DicomObject.job_id == Job.id).exists())
        .distinct()
    )
    with reading() as session:
        jobs = list(session.scalars(query))
    return sum(not _index_job(job_id) for job_id in jobs)


def _index_job(job_id: str) -> bool:
    """Index the results of a job, and return whether they can be listed."""
    try:
        planned = plan_objects(job_id)
        headers = _headers_of(planned)
    except Problem as problem:
        if problem.status in (429, 503):
            raise
        # 409: the job has no result to report, or somebody deleted one of its runs.
        if problem.status in (404, 409):
            return True
        failure = problem.code
    except Exception as error:
        failure = type(error).__name__
    else:
        _store(job_id, headers)
        return True
    log.warning("results_not_listed", job=job_id, error=failure)
    return False


def _headers_of(planned: JobObjects) -> dict[str, IndexedHeader]:
    """Return the headers of the DICOM objects of a job by name."""
    origin = planned.origin
    kept = {each.name: find_object(origin.job_id, each.name) for each in planned.objects}
    drawn_later = [each for each in planned.objects if kept[each.name] is None and each.series is not None]
    series = tuple(each.series for each in drawn_later if each.series is not None)
    later = run_in_pool(Task.WRITE_DICOM, picture_headers, origin, series) if series else []
    headers = {each.name: header for each, header in zip(drawn_later, later, strict=True)}
    return {each.name: headers.get(each.name) or _read(made_object(origin, each).path) for each in planned.objects}


def _read(path: Path) -> IndexedHeader:
    return run_in_pool(Task.READ_FILE, read_indexed, path)


def _store(job_id: str, headers: dict[str, IndexedHeader]) -> None:
    try:
        with writing() as session:
            if _is_listed(session, job_id):
                return
            for name, header in headers.items():
                dicom_index.add_result(session, job_id, name, header)
    except IntegrityError:
        # Another request listed them meanwhile, or somebody deleted the job.
        return


def _is_listed(session: Session, job_id: str) -> bool:
    return session.scalar(select(DicomObject.id).where(DicomObject.job_id == job_id).limit(1)) is not None
