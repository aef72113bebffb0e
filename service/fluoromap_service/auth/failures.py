"""Failed sign-ins of the last minute, in the database, where all replicas of the API count them."""

from __future__ import annotations

import ipaddress

from sqlalchemy import ColumnElement, delete, select

from fluoromap_service.store.clock import CLOCK_TOLERANCE_SECONDS, db_now
from fluoromap_service.store.disk import NoSpace
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import SignInFailure

MOST_FAILURES = 20
WINDOW_SECONDS = 60.0


def add(address: str) -> float | None:
    """Count a failure of an address.

    Returns
    -------
    float or None
        Seconds until the address may fail again, when it has failed too often. Such a failure is not stored.
    """
    source = network_of(address)
    recent = (
        select(SignInFailure.at + WINDOW_SECONDS - db_now())
        .where(SignInFailure.address == source, _is_recent())
        .order_by(SignInFailure.at.desc())
        .limit(MOST_FAILURES)
    )
    # A flood of wrong tokens must only read: on SQLite each write makes the service forget all callers.
    with reading() as session:
        waits = session.scalars(recent).all()
    if len(waits) == MOST_FAILURES:
        return waits[-1]
    try:
        with writing() as session:
            session.add(SignInFailure(address=source))
    except NoSpace:
        # Nothing can be counted on a full disk. The token is refused all the same.
        return None
    return None


def remove_old() -> None:
    """Delete the failures that no longer count."""
    with reading() as session:
        if session.scalar(select(SignInFailure.id).where(~_is_recent()).limit(1)) is None:
            return
    with writing() as session:
        session.execute(delete(SignInFailure).where(~_is_recent()))


def _is_recent() -> ColumnElement[bool]:
    # A time further in the future comes from before the clock was set back.
    return SignInFailure.at.between(db_now() - WINDOW_SECONDS, db_now() + CLOCK_TOLERANCE_SECONDS)


def network_of(address: str) -> str:
    """Return the source that a failure counts for: an IPv4 address, or an IPv6 network."""
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return "unknown"
    if isinstance(parsed, ipaddress.IPv6Address):
        if parsed.ipv4_mapped is not None:
            return str(parsed.ipv4_mapped)
        # One client can take any address of its /64, the network of one link (RFC 4291 section 2.5.1).
        return str(ipaddress.ip_network((int(parsed), 64), strict=False))
    return str(parsed)
