"""Reading what a job's stages stored."""

from __future__ import annotations

import functools
from collections.abc import Hashable, Sequence
from typing import Any, TypeVar, cast

from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap.store import files
from fluoromap.store.codec import decode
from fluoromap.store.models import StageRow

T = TypeVar("T")


def stages_of(session: Session, job_id: str, name: str | None = None) -> Sequence[StageRow]:
    """All stages of a job, or those of one name, in the order they were made."""
    query = select(StageRow).where(StageRow.job_id == job_id).order_by(StageRow.id)
    return session.scalars(query if name is None else query.where(StageRow.name == name)).all()


def stage_of(session: Session, job_id: str, name: str, subject: str | None = None) -> StageRow | None:
    """One stage of a job; ``subject`` may be left out for the stages a job has one of (match, triangulate, fuse)."""
    query = select(StageRow).where(StageRow.job_id == job_id, StageRow.name == name)
    return session.scalar(query if subject is None else query.where(StageRow.subject == subject))


def load(kind: type[T], stage: StageRow) -> T:
    """The decoded result of a stage that is done.

    Raises
    ------
    ValueError
        When the stage has no result.
    """
    if stage.result is None:
        raise ValueError(f"stage {stage.id} has no result")
    loaded: T = _decoded(cast(Hashable, kind), stage.result)
    return loaded


# Content-addressed and frozen: what was decoded once stays true.
@functools.lru_cache(maxsize=16)
def _decoded(kind: Any, sha256: str) -> Any:
    return decode(kind, files.path_of(sha256).read_bytes())
