"""Mapping studies: create, read, lock and delete them."""

from __future__ import annotations

import uuid

from sqlalchemy import bindparam, delete, select
from sqlalchemy.orm import Session

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.models import ENDED_JOB, Job, Rendering, StageRow, Study, StudyInstance
from fluoromap_service.study import instances
from fluoromap_service.study.catheters import set_catalogue
from fluoromap_service.study.instances import StudyRun, forget_instances


def create(
    session: Session,
    label: str,
    *,
    chamber: str | None = None,
    notes: str | None = None,
    catalogue: Catalogue = DEFAULT_CATALOGUE,
) -> Study:
    """Add a study and return it."""
    study = Study(id=uuid.uuid4().hex, label=label, chamber=chamber, notes=notes, gantry={})
    set_catalogue(study, catalogue)
    session.add(study)
    session.flush()
    session.refresh(study)
    return study


def get(session: Session, study_id: str) -> Study:
    """Return the study of an id.

    Raises
    ------
    Problem
        404 when there is none.
    """
    study = session.scalars(_STUDY, {"study_id": study_id}).one_or_none()
    if study is None:
        raise not_found("study")
    return study


_STUDY = select(Study).where(Study.id == bindparam("study_id"))
# Read it again under the lock: it may have changed since this session read it.
_LOCKED_STUDY = _STUDY.with_for_update().execution_options(populate_existing=True)
_NOW = select(db_now())


def runs_of(session: Session, study_id: str) -> list[StudyRun]:
    """Return the runs of a study in the order of arrival.

    Raises
    ------
    Problem
        404 when there is no such study.
    """
    runs = instances.runs_of(session, study_id)
    if not runs:
        get(session, study_id)
    return runs


def lock(session: Session, study_id: str) -> Study:
    """Return a study as :func:`get` does, locked for a change.

    Other transactions cannot change it until this one ends. The time of the change is stored.
    """
    study = session.scalars(_LOCKED_STUDY, {"study_id": study_id}).one_or_none()
    if study is None:
        raise not_found("study")
    # Its runs, sites and corrections have no times of their own.
    study.updated = session.scalars(_NOW).one()
    return study


def remove(session: Session, study_id: str) -> list[str]:
    """Delete a study and its jobs.

    The instances and files that nothing else refers to are deleted too.

    Returns
    -------
    list of str
        Hashes of files; give them to :func:`fluoromap_service.study.instances.unlink_unreferenced` after the commit.

    Raises
    ------
    Problem
        404 when there is none, 409 while a job runs.
    """
    study = session.scalar(select(Study).where(Study.id == study_id).with_for_update())
    if study is None:
        raise not_found("study")
    jobs = session.execute(select(Job.id, Job.state).where(Job.study_id == study_id)).all()
    if any(job.state not in ENDED_JOB for job in jobs):
        raise Problem(409, "job_running", "A job of this study is running; cancel it or wait for its end.")
    ids = [job.id for job in jobs]
    made = {sha256 for sha256 in session.scalars(select(StageRow.result).where(StageRow.job_id.in_(ids))) if sha256}
    made |= set(session.scalars(select(Rendering.sha256).where(Rendering.job_id.in_(ids))))
    runs = list(session.scalars(select(StudyInstance.sop_instance_uid).where(StudyInstance.study_id == study_id)))
    session.execute(delete(Study).where(Study.id == study_id))
    return forget_instances(session, runs, also=made)
