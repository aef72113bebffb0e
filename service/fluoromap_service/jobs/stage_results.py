"""What the stages of a job store, and reading it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap.contracts import ChamberMap, Track, View
from fluoromap.reasons import Reason
from fluoromap_service.store import files
from fluoromap_service.store.codec import decode
from fluoromap_service.store.models import StageRow

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class MapResult:
    """A map, or the reason why there is none with a sentence that says what to do."""

    chamber: ChamberMap | None
    refused: Reason | None
    message: str
    reference_mm: tuple[float, float, float] | None
    """Mean of the sites' reference positions: added to the map's coordinates it gives them from the isocentre."""


@dataclass(frozen=True, slots=True)
class ViewTrack:
    """One view of a site followed in 3D, or the reason why not."""

    view: View
    track: Track | None
    refused: Reason | None
    message: str


@dataclass(frozen=True, slots=True)
class SiteTracks:
    site: str
    views: tuple[ViewTrack, ...]


_AT_HAND_BYTES = 32 << 20
"""Most of what is at hand, as stored: a study's results are read again by each stage after them, and after a correction."""
_known: OrderedDict[str, tuple[Any, int]] = OrderedDict()
_lock = threading.Lock()


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
    with _lock:
        known, size = _known.get(stage.result, (None, 0))
    # Two kinds of results may have the same bytes.
    if not isinstance(known, kind):
        content = files.path_of(stage.result).read_bytes()
        known, size = decode(kind, content), len(content)
    remember(stage.result, known, size)
    return known


def remember(sha256: str, result: Any, size: int) -> None:
    """Keep a result at hand under hash and size of its stored form: content-addressed and frozen, it stays true."""
    with _lock:
        _known[sha256] = result, size
        _known.move_to_end(sha256)
        while sum(kept for _, kept in _known.values()) > _AT_HAND_BYTES:
            _known.popitem(last=False)
