"""Connections to the database, and transactions."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy import Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import Session

from fluoromap_service.settings import settings
from fluoromap_service.store.disk import NoSpace
from fluoromap_service.store.private_folder import make_private_file, make_private_folder

BUSY_TIMEOUT_MS = 30_000
DATABASE_AWAY = (OperationalError, InterfaceError, PoolTimeout)
"""The errors of a database that cannot be reached, is locked, or has no free connection."""

POSTGRESQL = {
    "connect_timeout": 5,
    "keepalives_idle": 30,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    "tcp_user_timeout": 30_000,
    "options": "-c lock_timeout=10s -c idle_in_transaction_session_timeout=60s",
}
"""Limits that free the locks of a host that vanished in the middle of a transaction."""


def _to_json(value: Any) -> str:
    """Return a value as JSON, quickly where it holds plain values only."""
    try:
        return _encode_json(value).decode()
    except (TypeError, UnicodeEncodeError):
        # The standard library takes subclasses of the plain types too, and text with halves of a surrogate pair.
        return json.dumps(value)


def _from_json(text: str | bytes) -> Any:
    """Return the value of a JSON text."""
    try:
        return _decode_json(text)
    except msgspec.DecodeError:
        # The standard library takes NaN, and halves of a surrogate pair.
        return json.loads(text)


_encode_json, _decode_json = msgspec.json.Encoder().encode, msgspec.json.Decoder().decode
# A correction in a study of 80 sites writes a thousand rows with JSON.
_OPTIONS: dict[str, Any] = {"hide_parameters": True, "json_serializer": _to_json, "json_deserializer": _from_json}


@functools.cache
def _engine(url: str) -> Engine:
    if not url.startswith("sqlite"):
        return create_engine(
            url, pool_pre_ping=True, pool_size=10, max_overflow=20, connect_args=POSTGRESQL, **_OPTIONS
        )
    make_private_folder(settings().data_dir)
    path = make_url(url).database
    if path and path != ":memory:":
        make_private_file(Path(path))
    engine = create_engine(
        url, connect_args={"check_same_thread": False, "timeout": BUSY_TIMEOUT_MS / 1000}, **_OPTIONS
    )
    event.listen(engine, "connect", _on_sqlite_connect)
    event.listen(engine, "begin", _on_sqlite_begin)
    return engine


def _on_sqlite_connect(connection: Any, record: Any) -> None:
    connection.isolation_level = None  # the driver's own BEGIN is too late to lock for writing
    # secure_delete: SQLite overwrites deleted rows with zeros; otherwise a deleted label could still be read in the file.
    pragmas = "journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON", "secure_delete=ON"
    for pragma in (*pragmas, f"busy_timeout={BUSY_TIMEOUT_MS}"):
        connection.execute(f"PRAGMA {pragma}")


def _on_sqlite_begin(connection: Connection) -> None:
    if connection.get_execution_options().get("writes", False):
        connection.exec_driver_sql("BEGIN IMMEDIATE")
        return
    # By the driver, past the work of SQLAlchemy: this BEGIN takes no lock, so it cannot fail.
    raw = connection.connection.driver_connection
    assert raw is not None
    raw.execute("BEGIN")


def engine() -> Engine:
    """Return the process's engine for the configured database."""
    return _engine(settings().effective_database_url)


def forget_engine() -> None:
    """Close all connections, so that the next one opens a database that was replaced."""
    engine().dispose()
    _engine.cache_clear()


@contextmanager
def reading() -> Iterator[Session]:
    """Open a transaction that only reads.

    Never write in it, because SQLite cannot upgrade its lock.
    """
    with Session(engine(), expire_on_commit=False) as session:
        yield session


@contextmanager
def writing() -> Iterator[Session]:
    """Open a transaction that writes.

    It commits at the end and rolls back on any exception.

    Raises
    ------
    NoSpace
        When the disk of the database is full.
    """
    try:
        with Session(engine().execution_options(writes=True), expire_on_commit=False) as session, session.begin():
            yield session
    except OperationalError as error:
        # SQLITE_FULL, and PostgreSQL's class 53100 disk_full
        if "database or disk is full" in str(error.orig) or getattr(error.orig, "sqlstate", None) == "53100":
            raise NoSpace from error
        raise


def empty_write_ahead_log() -> bool:
    """Move SQLite's write-ahead log into the database and empty it.

    Pages of deleted rows stay in the log until then. Return False when a reader prevents it now; PostgreSQL has its own
    clean-up.
    """
    if engine().dialect.name != "sqlite":
        return True
    with engine().connect() as connection:
        raw = connection.connection.driver_connection
        assert raw is not None
        raw.execute("PRAGMA busy_timeout=200")
        try:
            busy = raw.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]
        finally:
            raw.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")
    return not busy
