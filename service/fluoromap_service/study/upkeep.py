"""Regular clean-up: what nobody needs any more leaves the database and the disk."""

from __future__ import annotations

import structlog
from sqlalchemy import delete, func, select, update

from fluoromap_service.auth import failures, sessions
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings
from fluoromap_service.store import disk, files
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import empty_write_ahead_log, reading, writing
from fluoromap_service.store.models import Idempotency, Job, Rendering, Study
from fluoromap_service.study import deletion, dicom_index
from fluoromap_service.study.instances import unlink_unreferenced

ANSWER_SECONDS = 24 * 3600.0
"""Time for which the answer to a request with an Idempotency-Key is kept."""

LOW_DISK_FACTOR = 2
"""Kept pictures and reports are deleted when less than this many reserves are free."""

_BATCH = 100

log = structlog.get_logger(__name__)


def clean_up() -> None:
    """Remove everything that is out of date.

    Any process may call it at any time.
    """
    removed = files.remove_abandoned()
    if removed:
        log.info("incoming_files_removed", files=removed)
    with writing() as session:
        session.execute(delete(Idempotency).where(Idempotency.created < db_now() - ANSWER_SECONDS))
    sessions.remove_ended()
    failures.remove_old()
    if settings().retention_days > 0:
        delete_old_studies(settings().retention_days)
    _measure_renderings()
    low = disk.free_bytes() < LOW_DISK_FACTOR * disk.reserve_bytes()
    delete_renderings(0 if low else settings().renderings_mib * 2**20)
    empty_write_ahead_log()


def delete_old_studies(days: float) -> int:
    """Delete the studies without a change or job for so many days.

    Return how many.
    """
    last_job = select(func.max(Job.created)).where(Job.study_id == Study.id).scalar_subquery()
    limit = db_now() - days * 86400.0
    old = select(Study.id).where(Study.updated < limit, func.coalesce(last_job, 0.0) < limit)
    with reading() as session:
        found = list(session.scalars(old))
    deleted = 0
    for study_id in found:
        try:
            with writing() as session:
                # Somebody may have changed it since the search.
                if session.scalar(old.where(Study.id == study_id).with_for_update(of=Study)) is None:
                    continue
                unreferenced = deletion.delete(session, study_id, "retention")
        except Problem:
            # Somebody deleted it meanwhile, or its job still runs.
            continue
        deletion.remove_files(study_id, unreferenced)
        log.info("study_deleted_by_age", study=study_id)
        deleted += 1
    return deleted


def delete_renderings(most_bytes: int = 0) -> int:
    """Delete the longest unused pictures, meshes and pages until the others take ``most_bytes`` together.

    Return how many went. The service makes them again on request.
    """
    deleted = 0
    while True:
        with writing() as session:
            files.lock(session)
            excess = (session.scalar(select(func.sum(Rendering.bytes))) or 0) - most_bytes
            oldest = select(Rendering).order_by(func.coalesce(Rendering.used, 0.0), Rendering.id).limit(_BATCH)
            going = []
            jobs = set()
            for row in session.scalars(oldest):
                if excess <= 0:
                    break
                going.append(row.sha256)
                jobs.add(row.job_id)
                excess -= row.bytes or 0
                session.delete(row)
            dicom_index.forget_results(session, jobs)
            session.flush()
            unreferenced = [path.name for path in files.remove_unreferenced(session, going)]
        if not going:
            return deleted
        unlink_unreferenced(unreferenced)
        deleted += len(going)


def _measure_renderings() -> None:
    """Note the sizes of the renderings that an earlier version has made."""
    with reading() as session:
        unknown = session.execute(select(Rendering.id, Rendering.sha256).where(Rendering.bytes.is_(None))).all()
    if not unknown:
        return
    with writing() as session:
        for number, sha256 in unknown:
            path = files.path_of(sha256)
            size = path.stat().st_size if path.exists() else 0
            session.execute(update(Rendering).where(Rendering.id == number).values(bytes=size))
