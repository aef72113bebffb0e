"""Mapping studies."""

from __future__ import annotations

import uuid
from typing import Any

from sqlalchemy import delete, select, tuple_
from sqlalchemy.orm import Session

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter
from fluoromap_service.problem import Problem
from fluoromap_service.store.models import ENDED_JOB, Job, Rendering, StageRow, Study, StudyInstance
from fluoromap_service.study.instances import forget_instances


def catalogue_of(study: Study) -> Catalogue:
    """The study's catheters."""
    catheters = tuple(Catheter(**{**row, "spacing_mm": tuple(row["spacing_mm"])}) for row in study.catheters)
    return Catalogue(catheters, study.reference, study.mapping)


def catalogue_with_roles(catheters: tuple[Catheter, ...], reference: str | None) -> Catalogue:
    """A catalogue of these catheters with their roles.

    The mapping catheter is the one named ``mapping``, else the one with the longest tip. The reference catheter is the one
    asked for, else the one named ``reference``, else the first that does not map.

    Raises
    ------
    Problem
        422 when there are fewer than two, names repeat or the roles cannot be given.
    """
    if len(catheters) < 2:
        raise _unusable("catheters", "a study needs a mapping catheter and a reference catheter beside it")
    names = [catheter.name for catheter in catheters]
    mapping = "mapping" if "mapping" in names else max(catheters, key=lambda catheter: catheter.tip_mm).name
    if reference is None:
        others = [name for name in names if name != mapping]
        reference = "reference" if "reference" in others else next(iter(others), mapping)
    elif reference not in names:
        raise _unusable("reference", f"no catheter is named {reference!r}")
    elif reference == mapping:
        raise _unusable("reference", f"{reference!r} is the mapping catheter; the reference must be another one")
    try:
        return Catalogue(catheters, reference, mapping)
    except ValueError as error:
        raise _unusable("catheters", str(error)) from None


def _unusable(where: str, message: str) -> Problem:
    return Problem(422, "invalid_catheters", "The catheters do not make a usable set.", [(where, message)])


def catheter_rows(catalogue: Catalogue) -> list[Any]:
    """The catalogue's catheters as they are stored: spacings from centre to centre."""
    return [
        {
            "name": catheter.name,
            "electrodes": catheter.electrodes,
            "spacing_mm": list(catheter.spacing_mm),
            "tip_mm": catheter.tip_mm,
            "ring_mm": catheter.ring_mm,
        }
        for catheter in catalogue.catheters
    ]


def create(
    session: Session,
    label: str,
    *,
    chamber: str | None = None,
    notes: str | None = None,
    catalogue: Catalogue = DEFAULT_CATALOGUE,
) -> Study:
    """Add a study. Legacy XA has no FrameOfReferenceUID, so each study mints one (PS3.5 B.2)."""
    study = Study(
        id=uuid.uuid4().hex,
        label=label,
        chamber=chamber,
        notes=notes,
        catheters=catheter_rows(catalogue),
        reference=catalogue.reference,
        mapping=catalogue.mapping,
    )
    session.add(study)
    session.flush()
    session.refresh(study)
    return study


def get(session: Session, study_id: str) -> Study:
    """The study of that id.

    Raises
    ------
    Problem
        404 when there is none.
    """
    study = session.get(Study, study_id)
    if study is None:
        raise Problem(404, "not_found", "There is no such study.")
    return study


def lock(session: Session, study_id: str) -> Study:
    """As :func:`get`, and nobody else changes what hangs on the study until this transaction ends."""
    query = select(Study).where(Study.id == study_id).with_for_update()
    # Read again under the lock: what this session saw before may have changed since.
    study = session.scalars(query.execution_options(populate_existing=True)).one_or_none()
    if study is None:
        raise Problem(404, "not_found", "There is no such study.")
    return study


def newest_first(session: Session, limit: int, after: tuple[float, str] | None) -> list[Study]:
    """Up to ``limit`` studies, newest first, beginning after the one with that (created, id)."""
    query = select(Study).order_by(Study.created.desc(), Study.id.desc()).limit(limit)
    if after is not None:
        query = query.where(tuple_(Study.created, Study.id) < tuple_(*after))
    return list(session.scalars(query))


def remove(session: Session, study_id: str) -> list[str]:
    """Delete a study, its jobs, and the instances and files nothing else refers to.

    Returns
    -------
    list of str
        Hashes of files to hand to :func:`fluoromap_service.study.instances.unlink_unreferenced` after the commit.

    Raises
    ------
    Problem
        404 when there is none, 409 while a job runs.
    """
    study = session.scalar(select(Study).where(Study.id == study_id).with_for_update())
    if study is None:
        raise Problem(404, "not_found", "There is no such study.")
    jobs = session.execute(select(Job.id, Job.state).where(Job.study_id == study_id)).all()
    if any(job.state not in ENDED_JOB for job in jobs):
        raise Problem(409, "job_running", "A job of this study is running; cancel it or wait for its end.")
    ids = [job.id for job in jobs]
    made = {sha256 for sha256 in session.scalars(select(StageRow.result).where(StageRow.job_id.in_(ids))) if sha256}
    made |= set(session.scalars(select(Rendering.sha256).where(Rendering.job_id.in_(ids))))
    runs = list(session.scalars(select(StudyInstance.sop_instance_uid).where(StudyInstance.study_id == study_id)))
    session.execute(delete(Study).where(Study.id == study_id))
    return forget_instances(session, runs, also=made)
