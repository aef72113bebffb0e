"""Signs of life of the workers."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from fluoromap_service.store.clock import db_now
from fluoromap_service.store.models import WorkerSeen

WORKER_SECONDS = 30.0
"""A worker that is silent for longer counts as dead."""


def worker_seen(session: Session, name: str) -> None:
    """Store a worker's sign of life."""
    row = session.get(WorkerSeen, name)
    now = session.scalar(select(db_now())) or 0.0
    if row is None:
        session.add(WorkerSeen(name=name, seen=now))
    else:
        row.seen = now


def living_workers(session: Session, name: str | None = None) -> int:
    """Return how many workers gave a recent sign of life.

    Recent means within ``WORKER_SECONDS``. With ``name`` only the worker of that name counts.
    """
    # A time in the future comes from before the clock was set back.
    alive = WorkerSeen.seen.between(db_now() - WORKER_SECONDS, db_now() + WORKER_SECONDS)
    query = select(func.count()).select_from(WorkerSeen).where(alive)
    return session.scalar(query if name is None else query.where(WorkerSeen.name == name)) or 0
