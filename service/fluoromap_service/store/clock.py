"""The database's clock, because the clocks of hosts differ."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Float
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.expression import FunctionElement

CLOCK_TOLERANCE_SECONDS = 1.0
"""A stored time that lies further in the future comes from before the clock was set back."""


class db_now(FunctionElement[float]):  # noqa: N801 - reads as the SQL function it is
    """Seconds since 1970-01-01 UTC by the database's clock."""

    type = Float()
    inherit_cache = True


@compiles(db_now, "sqlite")
def _sqlite(element: db_now, compiler: Any, **options: Any) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(db_now, "postgresql")
def _postgresql(element: db_now, compiler: Any, **options: Any) -> str:
    # now() gives the start of the transaction: an old time after a long wait for a lock.
    return "EXTRACT(EPOCH FROM clock_timestamp())::double precision"
