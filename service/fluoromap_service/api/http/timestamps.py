"""Times as RFC 3339 in UTC."""

from __future__ import annotations

from datetime import UTC, datetime


def rfc3339(moment: float | datetime) -> str:
    """Seconds since 1970, or a moment with its zone, as for example ``2026-03-01T09:30:00.000Z``."""
    exact = datetime.fromtimestamp(moment, UTC) if isinstance(moment, int | float) else moment.astimezone(UTC)
    return exact.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def rfc3339_or_none(moment: float | datetime | None) -> str | None:
    """As :func:`rfc3339`; None stays None."""
    return None if moment is None else rfc3339(moment)
