"""Failures of the database, as the user reads them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy.exc import DBAPIError

from fluoromap_service.cli.failures import CommandFailed


@contextmanager
def explain_database_failures() -> Iterator[None]:
    """Turn each failure of the database into a sentence.

    Raises
    ------
    CommandFailed
        When the database cannot be reached or refuses a statement.
    """
    try:
        yield
    except DBAPIError as error:
        reason = str(error.orig).splitlines()[0]
        raise CommandFailed(f"The database cannot be used ({reason}); check FLUOROMAP_DATABASE_URL.") from error
