"""Times in the form of RFC 3339, in UTC."""

from __future__ import annotations

from datetime import UTC, datetime


def rfc3339(moment: float | datetime) -> str:
    """Return a time as for example ``2026-03-01T09:30:00.000Z``.

    Parameters
    ----------
    moment : float or datetime
        Seconds since 1970 UTC, or a datetime with a time zone.
    """
    exact = datetime.fromtimestamp(moment, UTC) if isinstance(moment, int | float) else moment.astimezone(UTC)
    return exact.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def rfc3339_or_none(moment: float | datetime | None) -> str | None:
    """Return a time as :func:`rfc3339` does; None stays None."""
    return None if moment is None else rfc3339(moment)
