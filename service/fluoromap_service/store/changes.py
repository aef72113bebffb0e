"""A sign that the database has changed, which costs no query."""

from __future__ import annotations

import functools
import sqlite3
import threading
from dataclasses import dataclass

from sqlalchemy import Engine

from fluoromap_service.store.engine import engine


class _Counter:
    """A connection that counts the commits of all other connections, because it never writes itself."""

    def __init__(self, database: Engine) -> None:
        # Made by the engine, so that it certainly counts the commits to the same database.
        pooled = database.raw_connection()
        assert pooled.driver_connection is not None
        self._connection = pooled.driver_connection
        pooled.detach()
        self._lock = threading.Lock()
        self._ask("PRAGMA busy_timeout=0")

    def number(self) -> int:
        return self._ask("PRAGMA data_version")

    def _ask(self, pragma: str) -> int:
        with self._lock:
            return int(self._connection.execute(pragma).fetchone()[0])


@dataclass(frozen=True, slots=True)
class Change:
    """The last change of a database. Between two equal ones nobody has committed anything.

    The numbers of two counters cannot be compared.
    """

    counter: _Counter
    number: int


def last_change() -> Change | None:
    """Return the last change of the configured database; None when the database cannot say.

    It never waits, so an event loop may call it. PostgreSQL has no such number.
    """
    counter = _counter(engine())
    try:
        return None if counter is None else Change(counter, counter.number())
    except sqlite3.Error:
        # Locked or away: the caller's own query finds out and says so.
        return None


@functools.lru_cache(maxsize=1)
def _counter(database: Engine) -> _Counter | None:
    # Each connection to ":memory:" has a database of its own.
    in_memory = database.url.database in (None, "", ":memory:")
    return None if database.dialect.name != "sqlite" or in_memory else _Counter(database)
