"""Partial results of a stage: stored with its result, and used again by the next job of the study.

A partial result has a key, the hash of the plugin, its version and parameters, and of the inputs that it depends on. It lies in
the file of the stage's result. So every worker process finds it, and it is deleted with that file.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Protocol, TypeVar

import structlog
from sqlalchemy import select

from fluoromap_service.jobs.job_life import Claim
from fluoromap_service.store import files
from fluoromap_service.store.array_pools import Block
from fluoromap_service.store.codec import (
    StoredOtherwise,
    block_of,
    decode,
    deferred,
    form_of,
    partial_results,
)
from fluoromap_service.store.engine import DATABASE_AWAY, reading
from fluoromap_service.store.models import Job, StageRow
from fluoromap_service.store.value_hash import digest

log = structlog.get_logger(__name__)

T = TypeVar("T")

_EARLIER_JOBS = 8
"""Number of the study's newest jobs whose results are searched for partial results."""
_EARLIER_RESULTS = 2
"""Number of their newest results whose partial results are used."""

_REMEMBERED_BYTES = 24 << 20
"""Size limit of the values that a process remembers, counted as stored. In memory they take more."""


class Connection(Protocol):
    """The connection of a stage to its worker."""

    def progress(self, fraction: float) -> None: ...

    def check(self) -> None: ...


class _Values:
    """The values of the partial results that this process used last, by the hashes of their stored forms.

    After a correction nearly all partial results are those of the job before, and decoding them takes as long as their work.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._remembered: OrderedDict[tuple[type, str], tuple[Any, int]] = OrderedDict()
        self._bytes = 0

    def value(self, kind: type[T], block: Block) -> T:
        """Return the value of a block.

        Raises
        ------
        StoredOtherwise
            When the block is no stored ``kind`` of these contracts.
        """
        name = kind, block.sha256
        with self._lock:
            if name in self._remembered:
                self._remembered.move_to_end(name)
                value: T = self._remembered[name][0]
                return value
        apart = getattr(kind, "stored_apart", False)
        value = deferred(kind, block.sha256, lambda: block.content) if apart else decode(kind, block.content)
        with self._lock:
            if name not in self._remembered:
                self._remembered[name] = value, len(block.content)
                self._bytes += len(block.content)
            while self._bytes > _REMEMBERED_BYTES:
                self._bytes -= self._remembered.popitem(last=False)[1][1]
        return value


_values = _Values()


class StageContext:
    """The :class:`fluoromap.contracts.Context` of a running stage.

    Parameters
    ----------
    connection : Connection
        Takes the progress, and stops the stage.
    held : Claim
        The stage.
    plugin : str
        Hash of everything that all partial results of the stage depend on.
    """

    def __init__(self, connection: Connection, held: Claim, plugin: str) -> None:
        self.progress, self.check = connection.progress, connection.check
        self.partial: dict[str, Block] = {}
        """Partial results that this stage used or computed, by their keys."""
        self._plugin = plugin
        self._unread = _earlier_results(held)
        self._earlier: list[Mapping[str, Block]] = []
        self._hashes: dict[int, tuple[Any, str]] = {}

    def recall(self, kind: type[T], inputs: tuple[object, ...], compute: Callable[[], T]) -> T:
        """Return a partial result from an earlier job of the study, or compute it."""
        key = digest(self._plugin, form_of(kind), *map(self._hash, inputs))
        block = self._stored(key)
        if block is not None:
            with suppress(StoredOtherwise):
                return self._used(key, kind, block)
        value = compute()
        self.partial[key] = block_of(value, finite=False)
        return value

    def _used(self, key: str, kind: type[T], block: Block) -> T:
        value = _values.value(kind, block)
        self.partial[key] = block
        return value

    def _hash(self, value: object) -> str:
        """Return the hash of an input; many partial results of one stage share inputs."""
        known = self._hashes.get(id(value))
        if known is None:
            # The value is held too: its number must not pass to another one.
            known = self._hashes[id(value)] = value, digest(value)
        return known[1]

    def _stored(self, key: str) -> Block | None:
        for partial in self._read_earlier():
            if key in partial:
                return partial[key]
        return self.partial.get(key)

    def _read_earlier(self) -> Iterator[Mapping[str, Block]]:
        yield from self._earlier
        # Without them the stage computes everything, so nothing that happens here may stop it.
        try:
            for partial in self._unread:
                self._earlier.append(partial)
                yield partial
        except (*DATABASE_AWAY, OSError) as error:
            log.warning("partial_results_unread", error=type(error).__name__)


def _earlier_results(held: Claim) -> Iterator[Mapping[str, Block]]:
    """Return the partial results of the stage's newest results in the study.

    Each file is read when it is needed.
    """
    with reading() as session:
        study = select(Job.study_id).where(Job.id == held.job_id).scalar_subquery()
        jobs = session.scalars(
            select(Job.id).where(Job.study_id == study).order_by(Job.created.desc(), Job.id.desc()).limit(_EARLIER_JOBS)
        ).all()
        newest = session.execute(
            select(StageRow.result, StageRow.id)
            .where(
                StageRow.job_id.in_(jobs), StageRow.name == held.name, StageRow.subject == held.subject,
                StageRow.result.is_not(None),
            )
            .order_by(StageRow.id.desc())
        ).all()  # fmt: skip
    for sha256 in list(dict.fromkeys(result for result, _ in newest if result))[:_EARLIER_RESULTS]:
        with suppress(files.BrokenFile, StoredOtherwise):
            yield partial_results(files.read(sha256))
