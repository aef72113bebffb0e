"""Sessions of browsers, and the links that begin one.

A session belongs to a token, has that token's scopes and ends with it. The store holds the hash of its id only. A link is a
session that nobody has opened yet: who opens it gets a new id, so a link works once.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass

from sqlalchemy import ColumnElement, and_, bindparam, delete, not_, select, update

from fluoromap_service.auth.tokens import Caller, Scope, is_valid, token_hash
from fluoromap_service.store import audit
from fluoromap_service.store.audit import Act
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import BrowserSession, Token

SESSION_SECONDS = 12 * 3600.0
"""Longest life of a session: a working day. Then its user signs in again."""

LINK_SECONDS = 600.0
"""Time in which somebody must open a link."""


MOST_SESSIONS = 1000
"""Most sessions and links of one token; the oldest end first. So no program fills the table with a token."""


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """A session in a list. Times are seconds since 1970 UTC."""

    token: str
    opened: float
    expires: float


def begin(token_sha256: str) -> str | None:
    """Begin a session with a token and return the session's id.

    The token is given by its hash. None when the token is not valid.
    """
    return _add(token_sha256, SESSION_SECONDS, opened=True)


def make_link(token: str) -> str | None:
    """Make the secret part of a link for the holder of a token.

    None when the token is not valid.
    """
    return _add(token_hash(token), LINK_SECONDS, opened=False)


def _add(token_sha256: str, seconds: float, *, opened: bool) -> str | None:
    secret = secrets.token_urlsafe(32)
    with writing() as session:
        found = session.execute(select(Token.id, db_now()).where(Token.sha256 == token_sha256, is_valid())).first()
        if found is None:
            return None
        token_id, now = found
        session.add(
            BrowserSession(
                sha256=token_hash(secret), token_id=token_id, opened=now if opened else None, expires=now + seconds
            )
        )
        session.flush()
        of_token = select(BrowserSession.id).where(BrowserSession.token_id == token_id)
        surplus = of_token.order_by(BrowserSession.id.desc()).offset(MOST_SESSIONS)
        session.execute(delete(BrowserSession).where(BrowserSession.id.in_(surplus.limit(MOST_SESSIONS))))
    return secret


def open_link(secret: str) -> str | None:
    """Open a link and return the id of the session.

    None when the link is unknown, used or too old.
    """
    session_id = secrets.token_urlsafe(32)
    of_valid_token = BrowserSession.token_id.in_(select(Token.id).where(is_valid()))
    waiting = and_(BrowserSession.opened.is_(None), BrowserSession.expires > db_now(), of_valid_token)
    with writing() as session:
        token_id = session.scalar(
            update(BrowserSession)
            .where(BrowserSession.sha256 == token_hash(secret), waiting)
            .values(sha256=token_hash(session_id), opened=db_now(), expires=db_now() + SESSION_SECONDS)
            .returning(BrowserSession.token_id)
        )
        if token_id is None:
            return None
        name = session.get_one(Token, token_id).name
        audit.append(session, [Act(name, "sign in by link")])
    return session_id


def end(session_sha256: str) -> None:
    """End a session, given by the hash of its id."""
    with writing() as session:
        session.execute(delete(BrowserSession).where(BrowserSession.sha256 == session_sha256))


def list_sessions() -> list[SessionInfo]:
    """Return the sessions that can be used, oldest first."""
    query = (
        select(Token.name, BrowserSession.opened, BrowserSession.expires)
        .join(Token, Token.id == BrowserSession.token_id)
        .where(_is_open())
        .order_by(BrowserSession.id)
    )
    with reading() as session:
        return [SessionInfo(name, opened or 0.0, expires) for name, opened, expires in session.execute(query)]


def remove_ended() -> int:
    """Delete the sessions and links that have ended.

    Return how many.
    """
    of_valid_token = BrowserSession.token_id.in_(select(Token.id).where(is_valid()))
    ended = not_(and_(BrowserSession.expires > db_now(), of_valid_token))
    with reading() as session:
        if session.scalar(select(BrowserSession.id).where(ended).limit(1)) is None:
            return 0
    with writing() as session:
        return len(session.execute(delete(BrowserSession).where(ended).returning(BrowserSession.id)).all())


def find(session_sha256: str) -> tuple[Caller, float] | None:
    """Return the caller of a session and the time of expiry.

    The session is given by the hash of its id. None when it is not valid.
    """
    with reading() as session:
        row = session.execute(_OPEN_SESSION, {"sha256": session_sha256}).first()
    if row is None:
        return None
    expires = row.expires if row.token_expires is None else min(row.expires, row.token_expires)
    return Caller(row.name, frozenset(Scope(scope) for scope in row.scopes)), expires


def _is_open() -> ColumnElement[bool]:
    return and_(BrowserSession.opened.is_not(None), BrowserSession.expires > db_now(), is_valid())


_OPEN_SESSION = (
    select(Token.name, Token.scopes, Token.expires.label("token_expires"), BrowserSession.expires)
    .join(Token, Token.id == BrowserSession.token_id)
    .where(BrowserSession.sha256 == bindparam("sha256"), _is_open())
)
