"""The results that stages store, and reading them."""

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
from fluoromap_service.problem import Problem
from fluoromap_service.store import files
from fluoromap_service.store.codec import StoredOtherwise, decode, deferred
from fluoromap_service.store.models import StageRow

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class MapResult:
    """The result of ``fuse``: a map, or the reason why there is none with a sentence that says what to do."""

    chamber: ChamberMap | None
    refused: Reason | None
    message: str
    reference_mm: tuple[float, float, float] | None
    """Mean of the sites' reference positions. Added to the map's coordinates it gives them from the isocentre."""


@dataclass(frozen=True, slots=True)
class ViewTrack:
    """The track of one view of a site, or the reason why there is none."""

    view: View
    track: Track | None
    refused: Reason | None
    message: str


@dataclass(frozen=True, slots=True)
class SiteTracks:
    """The result of ``monoplane``: the tracks of a site's views."""

    site: str
    views: tuple[ViewTrack, ...]


_REMEMBERED_BYTES = 20 << 20
"""Size limit of the decoded results that a process remembers, counted as stored. In memory they take more.

Each stage reads the results of the stages before it, and a correction reads most of them again.
"""
_remembered: OrderedDict[str, tuple[Any, int]] = OrderedDict()
_lock = threading.Lock()


def stages_of(session: Session, job_id: str, name: str | None = None) -> Sequence[StageRow]:
    """Return a job's stages, or those of one name, oldest first."""
    query = select(StageRow).where(StageRow.job_id == job_id).order_by(StageRow.id)
    return session.scalars(query if name is None else query.where(StageRow.name == name)).all()


def stage_of(session: Session, job_id: str, name: str, subject: str | None = None) -> StageRow | None:
    """Return one stage of a job; a stage about the whole study needs no ``subject``."""
    query = select(StageRow).where(StageRow.job_id == job_id, StageRow.name == name)
    return session.scalar(query if subject is None else query.where(StageRow.subject == subject))


def load(kind: type[T], stage: StageRow) -> T:
    """Return the decoded result of a stage that is done.

    Raises
    ------
    ValueError
        When the stage has no result.
    Problem
        409 ``result_outdated`` when another version of fluoromap stored it.
    BrokenFile
        When the stored file is missing or damaged.
    """
    if stage.result is None:
        raise ValueError(f"stage {stage.id} has no result")
    return load_file(kind, stage.result)


def load_once(kind: type[T], stage: StageRow) -> T:
    """Return the decoded result of a stage as :func:`load`, without remembering it.

    For a caller that reads the results of many stages one after the other: their arrays take more memory than the service may use.
    """
    sha256 = stage.result
    if sha256 is None:
        raise ValueError(f"stage {stage.id} has no result")
    with _lock:
        known, _ = _remembered.get(sha256, (None, 0))
    return known if isinstance(known, kind) else _decoded(kind, files.read(sha256))


def load_later(kind: type[T], stage: StageRow) -> T:
    """Return the result of a stage that is done, without reading it.

    Its file is read when the first field is read. That may raise the errors of :func:`load`. ``kind`` is a dataclass without slots.
    """
    sha256 = stage.result
    if sha256 is None:
        raise ValueError(f"stage {stage.id} has no result")
    return deferred(kind, sha256, lambda: files.read(sha256))


def load_file(kind: type[T], sha256: str) -> T:
    """Return the decoded result in a stored file, as :func:`load`."""
    with _lock:
        known, size = _remembered.get(sha256, (None, 0))
    # Two kinds of results may have the same bytes.
    if not isinstance(known, kind):
        content = files.read(sha256)
        known, size = _decoded(kind, content), len(content)
    remember(sha256, known, size)
    return known


def _decoded(kind: type[T], content: bytes) -> T:
    try:
        return decode(kind, content)
    except StoredOtherwise:
        sentence = "Another version of fluoromap stored this result. Start a new job to get it."
        raise Problem(409, "result_outdated", sentence) from None


def remember(sha256: str, result: Any, size: int) -> None:
    """Remember a decoded result under the hash of its stored form, which never changes."""
    with _lock:
        _remembered[sha256] = result, size
        _remembered.move_to_end(sha256)
        while sum(stored for _, stored in _remembered.values()) > _REMEMBERED_BYTES:
            _remembered.popitem(last=False)
