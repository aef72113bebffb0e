"""Access tokens with scopes and an expiry; the command line makes and revokes them, the store holds their hashes.

``admin`` implies ``write``, ``write`` implies ``read``, and ``read`` implies ``metrics``. A service without any token is open,
and listens on a loopback address only. A revoked or expired token still counts, so that revoking a token never opens the service.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import ColumnElement, and_, bindparam, or_, select
from sqlalchemy.exc import IntegrityError

from fluoromap_service.auth.addresses import is_loopback
from fluoromap_service.problem import Problem
from fluoromap_service.store import audit
from fluoromap_service.store.audit import Act
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Token


class Scope(StrEnum):
    """The kinds of things that a caller may do."""

    METRICS = "metrics"
    READ = "read"
    WRITE = "write"
    ADMIN = "admin"


SHORTEST_TOKEN = 32
"""Fewest characters of a token that the installation brings."""

_ORDER = (Scope.METRICS, Scope.READ, Scope.WRITE, Scope.ADMIN)


@dataclass(frozen=True, slots=True)
class Caller:
    """The sender of a request, with the scopes of its token."""

    name: str
    scopes: frozenset[Scope]

    def may(self, scope: Scope) -> bool:
        """Return whether one of the caller's scopes is ``scope`` or implies it."""
        return any(_ORDER.index(own) >= _ORDER.index(scope) for own in self.scopes)


OPEN = Caller("open", frozenset({Scope.ADMIN}))
"""The caller of an open service."""


@dataclass(frozen=True, slots=True)
class TokenInfo:
    """A token in a list, without its text. Times are seconds since 1970 UTC."""

    name: str
    scopes: tuple[Scope, ...]
    created: float
    expires: float | None
    revoked: float | None


def create_token(
    name: str, scopes: Iterable[str], expires_seconds: float | None = None, *, text: str | None = None
) -> str:
    """Make a token and return its text, which the store does not hold.

    Parameters
    ----------
    name : str
        Unique, 1 to 100 characters.
    scopes : iterable of str
        At least one :class:`Scope`.
    expires_seconds : float, optional
        Lifetime; by default the token does not expire.
    text : str, optional
        A secret of the installation, at least :data:`SHORTEST_TOKEN` characters; by default a random text.

    Raises
    ------
    Problem
        422 ``invalid_token`` when a parameter is wrong; 409 ``token_exists`` when the name or the text is in use.
    """
    if not name.strip() or len(name) > 100:
        raise _invalid("A token needs a name of at most 100 characters.")
    wanted = set(scopes)
    unknown = wanted - set(_ORDER)
    if unknown or not wanted:
        raise _invalid(f"A token needs at least one scope of {', '.join(_ORDER)}.")
    if expires_seconds is not None and not expires_seconds > 0:
        raise _invalid("A token must expire in the future; give a lifetime above 0.")
    if text is None:
        text = f"fm_{secrets.token_urlsafe(32)}"
    elif len(text) < SHORTEST_TOKEN:
        raise _invalid(f"A token needs at least {SHORTEST_TOKEN} characters; make a random one.")
    try:
        with writing() as session:
            now = session.scalars(select(db_now())).one()
            session.add(
                Token(
                    name=name,
                    sha256=token_hash(text),
                    scopes=[str(scope) for scope in _ORDER if scope in wanted],
                    created=now,
                    expires=None if expires_seconds is None else now + expires_seconds,
                )
            )
            audit.append(session, [Act("command line", f"token create {name}")])
    except IntegrityError:
        detail = f"There is already a token named {name!r}, or with this text; choose another."
        raise Problem(409, "token_exists", detail) from None
    return text


def list_tokens() -> list[TokenInfo]:
    """Return all tokens, also expired and revoked ones, oldest first."""
    with reading() as session:
        return [
            TokenInfo(row.name, tuple(Scope(scope) for scope in row.scopes), row.created, row.expires, row.revoked)
            for row in session.scalars(select(Token).order_by(Token.id))
        ]


def revoke_token(name: str) -> None:
    """End a token at once.

    Raises
    ------
    Problem
        404 when there is no token of that name.
    """
    with writing() as session:
        row = session.scalar(select(Token).where(Token.name == name))
        if row is None:
            raise Problem(404, "not_found", f"There is no token named {name!r}; see 'fluoromap token list'.")
        if row.revoked is None:
            row.revoked = session.scalars(select(db_now())).one()
            audit.append(session, [Act("command line", f"token revoke {name}")])


def any_token() -> bool:
    """Return whether there is any token, valid or not."""
    with reading() as session:
        return session.scalar(_A_TOKEN) is not None


_A_TOKEN = select(Token.id).limit(1)


def verify(text: str) -> Caller | None:
    """Return the caller of a token; None when the token is unknown, expired or revoked."""
    found = find(token_hash(text))
    return None if found is None else found[0]


def find(sha256: str) -> tuple[Caller, float | None] | None:
    """Return the caller of a token and the time of expiry.

    The token is given by its hash. None when the token is not valid.
    """
    with reading() as session:
        row = session.execute(_VALID_TOKEN, {"sha256": sha256}).first()
    return None if row is None else (Caller(row.name, frozenset(Scope(scope) for scope in row.scopes)), row.expires)


def is_valid() -> ColumnElement[bool]:
    """Return the condition that a token is neither revoked nor expired."""
    return and_(Token.revoked.is_(None), or_(Token.expires.is_(None), Token.expires > db_now()))


_VALID_TOKEN = select(Token.name, Token.scopes, Token.expires).where(Token.sha256 == bindparam("sha256"), is_valid())


def check_first_token(scopes: Iterable[str]) -> None:
    """Check that a first token may also write.

    It closes an open service. If it could only read, nobody could write any more.

    Raises
    ------
    Problem
        422 ``invalid_token`` when there is no token yet, and ``scopes`` lack ``write`` and ``admin``.
    """
    if not {Scope.WRITE, Scope.ADMIN} & set(scopes) and not any_token():
        raise _invalid(
            "The first token must be allowed to write, because it closes the service to everybody without a token. Make one "
            "with 'fluoromap token create --name NAME --scope read --scope write' first, then this one."
        )


def check_may_start(host: str) -> None:
    """Check that the service may listen on an address.

    Raises
    ------
    Problem
        403 ``token_needed`` when other machines can reach ``host`` and there is no token.
    """
    if not is_loopback(host) and not any_token():
        raise Problem(
            403,
            "token_needed",
            f"Listening on {host} needs an access token first: make one with "
            "'fluoromap token create --name NAME --scope read --scope write', or listen on 127.0.0.1.",
        )


def _invalid(detail: str) -> Problem:
    return Problem(422, "invalid_token", detail)


def token_hash(text: str) -> str:
    """Return the SHA-256 of a token's text, in hexadecimal digits."""
    # A token is 256 random bits: a plain hash cannot be searched backwards, a slow one would only cost time.
    return hashlib.sha256(text.encode()).hexdigest()
