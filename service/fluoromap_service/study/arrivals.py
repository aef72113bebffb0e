"""Runs that come through a DICOM door: each joins the mapping study of its DICOM study."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import select, text
from sqlalchemy.orm import Session

from fluoromap_service.dicom.facts import InstanceFacts
from fluoromap_service.dicom.indexed_header import ReadRun
from fluoromap_service.store import audit
from fluoromap_service.store.audit import Act
from fluoromap_service.store.models import Study
from fluoromap_service.study import instances, studies

_LOCK = 0x70616373  # "pacs" in ASCII; any number that no other lock of this database uses


def add_arrival(session: Session, path: Path, run: ReadRun, sha256: str, act: Act) -> tuple[str, bool]:
    """Store a run from a DICOM door in the mapping study of its DICOM study.

    The run joins the newest mapping study that a DICOM door made for its Study Instance UID. Where there is none, a new
    one is made.

    Parameters
    ----------
    session : Session
    path : Path
        The incoming file.
    run : ReadRun
    sha256 : str
        Hash of the file.
    act : Act
        The entry of the audit trail, still without a study.

    Returns
    -------
    tuple of str and bool
        Id of the mapping study, and whether the run is new in it.

    Raises
    ------
    Problem
        409 when the store has another data set under the same SOP Instance UID.
    """
    if session.get_bind().dialect.name == "postgresql":
        # Two associations must not make two studies. SQLite has only one writer at a time.
        session.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _LOCK})
    study = _study_of(session, run.facts)
    new = instances.add(session, study.id, path, run, sha256, file_name=None, site=None)
    audit.append(session, [Act(act.who, act.what, study.id, status=act.status)])
    return study.id, new


def _study_of(session: Session, facts: InstanceFacts) -> Study:
    newest = session.scalar(
        select(Study.id)
        .where(Study.study_instance_uid == facts.study_instance_uid)
        .order_by(Study.created.desc(), Study.id.desc())
        .limit(1)
    )
    if newest is not None:
        return studies.lock(session, newest)
    # A label must not name the patient: the date is all that the header offers.
    date = "" if facts.acquired is None else f" of {facts.acquired:%Y-%m-%d}"
    study = studies.create(session, f"DICOM study{date}")
    study.study_instance_uid = facts.study_instance_uid
    session.flush()
    return study
