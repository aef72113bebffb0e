"""The audit trail: who did what to which study, append-only, with a chain of hashes.

Each entry holds the hash of the entry before it and of its own content. A changed, removed or inserted entry breaks the chain.
The database refuses to change or delete an entry. Entries name studies and jobs by their ids only, and hold no patient data.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select, text
from sqlalchemy.orm import Session

from fluoromap_service.store.clock import db_now
from fluoromap_service.store.models import AuditEntry, Instance, Job, StudyInstance

START = "0" * 64
"""The hash before the first entry."""

_LOCK = 0x61756469  # "audi" in ASCII; any number that no other lock of this database uses


@dataclass(frozen=True, slots=True)
class Act:
    """One thing that somebody did.

    Parameters
    ----------
    who : str
        Name of the access token, "open" for a service without tokens, "command line" or "retention".
    what : str
        Method and route, or the command.
    study, job : str or None
        Ids of the study and job concerned.
    status : int or None
        HTTP status of the answer.
    dicom_study : str or None
        Study Instance UID that a DICOMweb request names. The trail does not hold it: it has an entry for each mapping study with
        runs of this DICOM study.
    times : int
        How often it happened.
    """

    who: str
    what: str
    study: str | None = None
    job: str | None = None
    status: int | None = None
    dicom_study: str | None = None
    times: int = 1


class BrokenChain(Exception):
    """An entry does not fit to the entry before it; the message names it."""


def append(session: Session, acts: Sequence[Act]) -> list[AuditEntry]:
    """Add acts to the end of the trail, and return their entries.

    It works within the caller's transaction. An act on a job is recorded with the job's study.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _LOCK})
    jobs = {act.job for act in acts if act.job is not None and act.study is None}
    rows = session.execute(select(Job.id, Job.study_id).where(Job.id.in_(jobs))).all()
    studies = {row.id: row.study_id for row in rows}
    before = session.scalar(select(AuditEntry.hash).order_by(AuditEntry.id.desc()).limit(1)) or START
    now = session.scalars(select(db_now())).one()
    held = _mapping_studies(session, {act.dicom_study for act in acts if act.dicom_study is not None})
    added = []
    for act in acts:
        own: list[str | None] = [act.study or studies.get(act.job or "")]
        for study in held.get(act.dicom_study or "", own):
            entry = AuditEntry(at=now, who=act.who, what=act.what, study=study, job=act.job, status=act.status)
            entry.times = act.times if act.times > 1 else None
            entry.hash = before = _hash(before, entry)
            session.add(entry)
            # One by one, so that the ids rise in the order of the chain.
            session.flush()
            added.append(entry)
    return added


def _mapping_studies(session: Session, dicom_studies: set[str]) -> dict[str, list[str | None]]:
    """Return the mapping studies with runs of each DICOM study, by UID."""
    if not dicom_studies:
        return {}
    query = (
        select(Instance.study_instance_uid, StudyInstance.study_id)
        .join(StudyInstance, StudyInstance.sop_instance_uid == Instance.sop_instance_uid)
        .where(Instance.study_instance_uid.in_(dicom_studies))
        .distinct()
        .order_by(StudyInstance.study_id)
    )
    found: dict[str, list[str | None]] = {}
    for uid, study in session.execute(query):
        found.setdefault(uid, []).append(study)
    return found


def entries(session: Session) -> Iterator[AuditEntry]:
    """Yield all entries, oldest first."""
    yield from session.scalars(select(AuditEntry).order_by(AuditEntry.id).execution_options(yield_per=1000))


def as_json(entry: AuditEntry) -> dict[str, Any]:
    """Return an entry as JSON values; ``at`` is in seconds since 1970 UTC."""
    return {"id": entry.id, **_content(entry), "hash": entry.hash}


def verify(session: Session, heads: Iterable[str] = ()) -> tuple[int, str]:
    """Check the whole chain.

    Parameters
    ----------
    session : Session
    heads : iterable of str
        Hashes of entries that must be in the trail, from earlier checks or as the service published them. They show that nobody has
        cut off the end, emptied the trail or written it anew.

    Returns
    -------
    tuple of int and str
        The number of entries and the hash of the last one.

    Raises
    ------
    BrokenChain
        When an entry was changed, removed or inserted, or a hash is missing.
    """
    before, count, missing = START, 0, set(heads) - {START}
    for entry in entries(session):
        if entry.hash != _hash(before, entry):
            raise BrokenChain(f"Entry {entry.id} of the audit trail, or the entry before it, was changed or removed.")
        before, count = entry.hash, count + 1
        missing.discard(entry.hash)
    if missing:
        raise BrokenChain(
            f"The audit trail lacks {len(missing)} of the given hashes: its end was removed, or somebody wrote it anew."
        )
    return count, before


def _content(entry: AuditEntry) -> dict[str, Any]:
    return {
        "at": round(entry.at, 6), "who": entry.who, "what": entry.what, "study": entry.study, "job": entry.job,
        "status": entry.status, **({} if entry.times is None else {"times": entry.times}),
    }  # fmt: skip


def _hash(before: str, entry: AuditEntry) -> str:
    content = json.dumps(_content(entry), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(f"{before}{content}".encode()).hexdigest()
