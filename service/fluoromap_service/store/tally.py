"""Sums over the life of the installation, such as the number of failed stages; the metrics report them."""

from __future__ import annotations

import functools
from collections.abc import Mapping

from sqlalchemy import Insert, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from fluoromap_service.store.models import Tally


def add(session: Session, amounts: Mapping[str, float]) -> None:
    """Add an amount to each named sum, within the caller's transaction."""
    # In one order, so that no two transactions wait for each other.
    rows = [{"name": name, "value": amounts[name]} for name in sorted(amounts)]
    session.execute(_addition(session.get_bind().dialect.name), rows)


@functools.cache
def _addition(dialect: str) -> Insert:
    """Return the statement that adds one amount.

    It is built and compiled once, because each end of a stage runs it.
    """
    insert = postgresql.insert if dialect == "postgresql" else sqlite.insert
    statement = insert(Tally)
    return statement.on_conflict_do_update(
        index_elements=["name"], set_={"value": Tally.value + statement.excluded["value"]}
    )


def all_sums(session: Session) -> dict[str, float]:
    """Return all sums by their names."""
    return {row.name: row.value for row in session.scalars(select(Tally))}
