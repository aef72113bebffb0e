"""Sessions of browsers: a cookie that holds the access token, so that pages need no header.

Scripts cannot read the cookie (HttpOnly), and other sites cannot send it (SameSite=Strict). Pages of other ports of the same
machine count as the same site, so a request that writes must also come from the service's own origin.
"""

from __future__ import annotations

import base64
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection
from starlette.responses import Response

from fluoromap_service.problem import Problem

COOKIE = "fluoromap_session"
_READING = frozenset({"GET", "HEAD", "OPTIONS"})


def session_token(connection: HTTPConnection) -> str | None:
    """Return the token of the browser's session; None without a session.

    Raises
    ------
    Problem
        403 ``foreign_origin`` when a page of another origin tries to write.
    """
    packed = connection.cookies.get(COOKIE)
    if not packed:
        return None
    if connection.scope.get("method") not in _READING and not _from_own_page(connection):
        raise Problem(403, "foreign_origin", "A browser's session may change things from the service's own pages only.")
    try:
        return base64.urlsafe_b64decode(packed.encode()).decode()
    except ValueError:
        return None


def begin_session(response: Response, token: str, *, secure: bool) -> None:
    """Set the cookie, which ends with the browser."""
    packed = base64.urlsafe_b64encode(token.encode()).decode()
    response.set_cookie(COOKIE, packed, path="/", secure=secure, httponly=True, samesite="strict")


def end_session(response: Response) -> None:
    """Remove the cookie."""
    response.delete_cookie(COOKIE, path="/", httponly=True, samesite="strict")


def _from_own_page(connection: HTTPConnection) -> bool:
    origin = connection.headers.get("origin")
    if origin is None:
        return connection.headers.get("sec-fetch-site") == "same-origin"
    try:
        return urlsplit(origin).netloc.lower() == connection.headers.get("host", "").lower()
    except ValueError:
        return False
