"""Access tokens: made by the command line, kept as hashes, with scopes, an expiry and a way to revoke them.

``admin`` implies ``write``, ``write`` implies ``read``. A service that no token was ever made for is open on a loopback
address and refuses every other one; a revoked or expired token still counts as made, so revoking never opens a service.
"""

from __future__ import annotations

import hashlib
import ipaddress
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import or_, select
from sqlalchemy.exc import IntegrityError

from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Token


class Scope(StrEnum):
    """What a caller may do."""

    READ = "read"
    WRITE = "write"
    ADMIN = "admin"


SHORTEST_GIVEN = 32
"""Characters that a token drawn elsewhere needs at least."""

_ORDER = (Scope.READ, Scope.WRITE, Scope.ADMIN)


class TokenProblem(ValueError):
    """A token that cannot be made or revoked; the message says why."""


class StartRefused(RuntimeError):
    """The service must not listen on that address; the message says what to do."""


@dataclass(frozen=True, slots=True)
class Caller:
    """Who sent a request, and what they may do."""

    name: str
    scopes: frozenset[Scope]

    def may(self, scope: Scope) -> bool:
        """Whether one of the caller's scopes is ``scope`` or implies it."""
        return any(_ORDER.index(own) >= _ORDER.index(scope) for own in self.scopes)


OPEN = Caller("open", frozenset({Scope.ADMIN}))
"""The caller of an open service."""


@dataclass(frozen=True, slots=True)
class TokenInfo:
    """A token as listed. Times are seconds since 1970 UTC."""

    name: str
    scopes: tuple[Scope, ...]
    created: float
    expires: float | None
    revoked: float | None


def create_token(
    name: str, scopes: Iterable[str], expires_seconds: float | None = None, *, text: str | None = None
) -> str:
    """Make a token and return its text, which is not kept and cannot be shown again.

    ``text`` gives one that was drawn elsewhere (a secret of the installation); by default it is drawn here.

    Raises
    ------
    TokenProblem
        When the name is empty, too long or taken, a scope is unknown, the lifetime is not positive or ``text`` is short.
    """
    if not name.strip() or len(name) > 100:
        raise TokenProblem("a token needs a name of at most 100 characters")
    wanted = set(scopes)
    unknown = wanted - set(_ORDER)
    if unknown or not wanted:
        raise TokenProblem(f"a token needs at least one scope of {', '.join(_ORDER)}")
    if expires_seconds is not None and not expires_seconds > 0:
        raise TokenProblem("a token must expire in the future")
    if text is None:
        text = f"fm_{secrets.token_urlsafe(32)}"
    elif len(text) < SHORTEST_GIVEN:
        raise TokenProblem(f"a given token needs at least {SHORTEST_GIVEN} characters; draw it at random")
    try:
        with writing() as session:
            now = session.scalars(select(db_now())).one()
            session.add(
                Token(
                    name=name,
                    sha256=_hash(text),
                    scopes=[str(scope) for scope in _ORDER if scope in wanted],
                    created=now,
                    expires=None if expires_seconds is None else now + expires_seconds,
                )
            )
    except IntegrityError:
        raise TokenProblem(f"there is already a token named {name!r}, or with this text; choose another") from None
    return text


def list_tokens() -> list[TokenInfo]:
    """All tokens ever made, oldest first."""
    with reading() as session:
        return [
            TokenInfo(row.name, tuple(Scope(scope) for scope in row.scopes), row.created, row.expires, row.revoked)
            for row in session.scalars(select(Token).order_by(Token.id))
        ]


def revoke_token(name: str) -> None:
    """End a token at once.

    Raises
    ------
    TokenProblem
        When there is no token of that name.
    """
    with writing() as session:
        row = session.scalar(select(Token).where(Token.name == name))
        if row is None:
            raise TokenProblem(f"there is no token named {name!r}")
        if row.revoked is None:
            row.revoked = session.scalars(select(db_now())).one()


def any_token() -> bool:
    """Whether a token was ever made, valid or not."""
    with reading() as session:
        return session.scalar(select(Token.id).limit(1)) is not None


def verify(text: str) -> Caller | None:
    """The caller that a token stands for; None when it is unknown, expired or revoked."""
    query = select(Token).where(
        Token.sha256 == _hash(text),
        Token.revoked.is_(None),
        or_(Token.expires.is_(None), Token.expires > db_now()),
    )
    with reading() as session:
        row = session.scalar(query)
    return None if row is None else Caller(row.name, frozenset(Scope(scope) for scope in row.scopes))


def is_loopback(host: str) -> bool:
    """Whether an address or name can only be reached from this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def check_may_start(host: str) -> None:
    """Refuse to listen where others could reach a service that asks for no token.

    Raises
    ------
    StartRefused
        When ``host`` is not a loopback address and no token was ever made.
    """
    if not is_loopback(host) and not any_token():
        raise StartRefused(
            f"Listening on {host} needs an access token first: make one with "
            "'fluoromap token create --name NAME --scope read --scope write', or listen on 127.0.0.1."
        )


def _hash(text: str) -> str:
    # A token is 256 random bits: a plain hash cannot be searched backwards, a slow one would only cost time.
    return hashlib.sha256(text.encode()).hexdigest()
