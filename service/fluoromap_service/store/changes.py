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

    def __init__(self, path: str) -> None:
        self._connection = sqlite3.connect(path, timeout=0, isolation_level=None, check_same_thread=False)
        self._lock = threading.Lock()

    def number(self) -> int:
        with self._lock:
            return int(self._connection.execute("PRAGMA data_version").fetchone()[0])


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
    path = database.url.database
    if database.dialect.name != "sqlite" or not path or path == ":memory:":
        return None
    return _Counter(path)
