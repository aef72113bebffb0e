"""The cookie of a browser's session, so that pages need no header.

Scripts cannot read the cookie (HttpOnly), and other sites cannot send it (SameSite=Strict). Pages of other ports of the same
machine count as the same site, so a request that writes must also come from the service's own origin.
"""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.requests import HTTPConnection
from starlette.responses import Response

from fluoromap_service.api.http.hosts import host_name, is_forwarded
from fluoromap_service.auth import is_loopback
from fluoromap_service.problem import Problem

COOKIE = "fluoromap_session"
_READING = frozenset({"GET", "HEAD", "OPTIONS"})


def session_id(connection: HTTPConnection) -> str | None:
    """Return the id of the browser's session; None without a session.

    Raises
    ------
    Problem
        403 ``foreign_origin`` when a page of another origin tries to write.
    """
    found = connection.cookies.get(COOKIE)
    if not found:
        return None
    if connection.scope.get("method") not in _READING and not _from_own_page(connection):
        raise Problem(403, "foreign_origin", "A browser's session may change things from the service's own pages only.")
    return found


def set_cookie(connection: HTTPConnection, response: Response, new_id: str) -> None:
    """Set the cookie, which ends with the browser.

    Everywhere but on this machine a browser sends it over TLS only (Secure).
    """
    name = host_name(connection)
    # A proxy may speak TLS to the browser and call the service as localhost.
    local = name is not None and is_loopback(name) and not is_forwarded(connection)
    secure = connection.scope["scheme"] == "https" or not local
    response.set_cookie(COOKIE, new_id, path="/", secure=secure, httponly=True, samesite="strict")


def remove_cookie(response: Response) -> None:
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
