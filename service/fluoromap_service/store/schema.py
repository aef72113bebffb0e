"""Bring the database's schema up to date."""

from __future__ import annotations

import fcntl
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection, text

from fluoromap_service.settings import settings
from fluoromap_service.store.engine import engine

MIGRATIONS = "fluoromap_migrations"
"""The package that holds the migrations: found by name, because the store knows nothing of the floors above."""

_POSTGRESQL_LOCK = 0x666C756F  # "fluo": any number that nobody else takes in this database


def configuration() -> Config:
    """Alembic's configuration, for the migrations as they are installed."""
    spec = importlib.util.find_spec(MIGRATIONS)
    if spec is None or not spec.submodule_search_locations:
        raise RuntimeError(f"the package {MIGRATIONS} is not installed; install fluoromap again")
    config = Config()
    # A percent sign in the path would be read as interpolation.
    config.set_main_option("script_location", next(iter(spec.submodule_search_locations)).replace("%", "%%"))
    return config


def upgrade() -> None:
    """Create or migrate the tables of the configured database to the newest revision, all or nothing.

    May be called by several processes at once: one does it, the others wait and find it done.
    """
    config = configuration()
    with _alone() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


@contextmanager
def _alone() -> Iterator[Connection]:
    """A connection in a transaction that nobody else can be migrating in."""
    if engine().dialect.name == "sqlite":
        settings().data_dir.mkdir(parents=True, exist_ok=True)
        with (settings().data_dir / "migration.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            with engine().connect() as plain:
                raw = plain.connection.driver_connection
                assert raw is not None
                # Copying a table drops the old one, which would delete by cascade whatever refers to its rows; the
                # setting can only be changed outside a transaction.
                raw.execute("PRAGMA foreign_keys=OFF")
                try:
                    connection = plain.execution_options(writes=True)
                    with connection.begin():
                        yield connection
                finally:
                    raw.execute("PRAGMA foreign_keys=ON")
    else:
        with engine().begin() as connection:
            connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _POSTGRESQL_LOCK})
            yield connection
