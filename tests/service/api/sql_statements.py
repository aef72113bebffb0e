"""The SQL that the service runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import event

from fluoromap_service.store.engine import engine


@contextmanager
def sql_statements() -> Iterator[list[str]]:
    """Gather the statements of the configured database."""
    found: list[str] = []

    def add(connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        found.append(statement)

    event.listen(engine(), "before_cursor_execute", add)
    try:
        yield found
    finally:
        event.remove(engine(), "before_cursor_execute", add)
