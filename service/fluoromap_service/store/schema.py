"""Migrate the database to the newest schema."""

from __future__ import annotations

import fcntl
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, text

from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import engine

MIGRATIONS = "fluoromap_migrations"
"""Package of the migrations; the store finds it by name, because it imports nothing from the floors above."""

_POSTGRESQL_LOCK = 0x666C756F  # "fluo" in ASCII; any number that no other lock of this database uses


def configuration() -> Config:
    """Return Alembic's configuration for the installed migrations."""
    spec = importlib.util.find_spec(MIGRATIONS)
    if spec is None or not spec.submodule_search_locations:
        raise RuntimeError(f"The package {MIGRATIONS} is not installed; install fluoromap again.")
    config = Config()
    # Alembic would read a percent sign in the path as interpolation.
    config.set_main_option("script_location", next(iter(spec.submodule_search_locations)).replace("%", "%%"))
    return config


def upgrade() -> None:
    """Create or migrate the tables of the configured database, all or nothing.

    Several processes may call it at once: one migrates, the others wait for it.
    """
    config = configuration()
    with _alone() as connection:
        _refuse_newer(connection, config)
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def check() -> None:
    """Check that the database has the tables of this version.

    Raises
    ------
    Problem
        503 ``schema_newer`` or ``schema_outdated``; the sentence says what to do.
    """
    config = configuration()
    with engine().connect() as connection:
        _refuse_newer(connection, config)
        current = set(MigrationContext.configure(connection).get_current_heads())
    if current != set(ScriptDirectory.from_config(config).get_heads()):
        detail = "The database lacks the tables of this version; run 'fluoromap db upgrade' first."
        raise Problem(503, "schema_outdated", detail)


def _refuse_newer(connection: Connection, config: Config) -> None:
    known = {revision.revision for revision in ScriptDirectory.from_config(config).walk_revisions()}
    if not set(MigrationContext.configure(connection).get_current_heads()) <= known:
        detail = "A newer version of fluoromap made this database; install that version, or restore an older backup."
        raise Problem(503, "schema_newer", detail)


@contextmanager
def _alone() -> Iterator[Connection]:
    """Open a connection and keep all other processes from migrating meanwhile."""
    if engine().dialect.name == "sqlite":
        with (settings().data_dir / "migration.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            with engine().connect() as plain:
                raw = plain.connection.driver_connection
                assert raw is not None
                # A migration copies a table and drops the old one, which would delete by cascade all rows that refer
                # to it. SQLite changes this setting outside transactions only.
                raw.execute("PRAGMA foreign_keys=OFF")
                try:
                    connection = plain.execution_options(writes=True)
                    with connection.begin():
                        yield connection
                finally:
                    raw.execute("PRAGMA foreign_keys=ON")
    else:
        with engine().begin() as connection:
            # A migration of another process may last longer than any other lock.
            connection.execute(text("SET LOCAL lock_timeout = 0"))
            connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _POSTGRESQL_LOCK})
            connection.execute(text("SET LOCAL lock_timeout TO DEFAULT"))
            yield connection
