"""The audit trail: who did what to which study, append-only, with a chain of hashes.

Each entry holds the hash of the entry before it and of its own content. A changed, removed or inserted entry breaks the chain.
The database refuses to change or delete an entry. Entries name studies and jobs by their ids only, and hold no patient data.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select, text
from sqlalchemy.orm import Session

from fluoromap_service.store.clock import db_now
from fluoromap_service.store.models import AuditEntry, Job

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
    """

    who: str
    what: str
    study: str | None = None
    job: str | None = None
    status: int | None = None


class BrokenChain(Exception):
    """An entry does not fit to the entry before it; the message names it."""


def append(session: Session, acts: Sequence[Act]) -> None:
    """Add acts to the end of the trail, within the caller's transaction.

    An act on a job is recorded with the job's study.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _LOCK})
    jobs = {act.job for act in acts if act.job is not None and act.study is None}
    rows = session.execute(select(Job.id, Job.study_id).where(Job.id.in_(jobs))).all()
    studies = {row.id: row.study_id for row in rows}
    before = session.scalar(select(AuditEntry.hash).order_by(AuditEntry.id.desc()).limit(1)) or START
    now = session.scalars(select(db_now())).one()
    for act in acts:
        study = act.study or studies.get(act.job or "")
        entry = AuditEntry(at=now, who=act.who, what=act.what, study=study, job=act.job, status=act.status)
        entry.hash = before = _hash(before, entry)
        session.add(entry)
        # One by one, so that the ids rise in the order of the chain.
        session.flush()


def entries(session: Session) -> Iterator[AuditEntry]:
    """Yield all entries, oldest first."""
    yield from session.scalars(select(AuditEntry).order_by(AuditEntry.id).execution_options(yield_per=1000))


def as_json(entry: AuditEntry) -> dict[str, Any]:
    """Return an entry as JSON values; ``at`` is in seconds since 1970 UTC."""
    return {"id": entry.id, **_content(entry), "hash": entry.hash}


def verify(session: Session, head: str | None = None) -> tuple[int, str]:
    """Check the whole chain.

    Parameters
    ----------
    session : Session
    head : str, optional
        Hash of an entry that must be in the trail, from an earlier check. It shows that nobody has cut off the end.

    Returns
    -------
    tuple of int and str
        The number of entries and the hash of the last one.

    Raises
    ------
    BrokenChain
        When an entry was changed, removed or inserted.
    """
    before, count, found = START, 0, head is None
    for entry in entries(session):
        if entry.hash != _hash(before, entry):
            raise BrokenChain(f"Entry {entry.id} of the audit trail, or the entry before it, was changed or removed.")
        before, count = entry.hash, count + 1
        found = found or entry.hash == head
    if not found:
        raise BrokenChain("The audit trail does not contain the given hash: its end was removed.")
    return count, before


def _content(entry: AuditEntry) -> dict[str, Any]:
    return {
        "at": round(entry.at, 6), "who": entry.who, "what": entry.what, "study": entry.study, "job": entry.job,
        "status": entry.status,
    }  # fmt: skip


def _hash(before: str, entry: AuditEntry) -> str:
    content = json.dumps(_content(entry), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(f"{before}{content}".encode()).hexdigest()
