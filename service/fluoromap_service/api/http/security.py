"""Access control: every request passes the doorkeeper, so a new route cannot forget it."""

from __future__ import annotations

import functools
from typing import Annotated

import structlog
from anyio import CapacityLimiter, to_thread
from fastapi import Depends, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as AsgiScope

from fluoromap_service import auth
from fluoromap_service.api.http.hosts import check_host, host_name, is_forwarded
from fluoromap_service.api.http.problems import answer, database_away
from fluoromap_service.api.http.session import session_id
from fluoromap_service.api.http.sign_in_limit import SignInLimit
from fluoromap_service.auth import Caller, Callers, Credential, Scope
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import DATABASE_AWAY

SIGN_IN = "/sign-in"
SESSION = "/session"
METRICS = "/metrics"
OPEN_PATHS = frozenset(
    {"/v1/health", "/v1/ready", SIGN_IN, "/assets/style.css", "/assets/icon.svg", "/assets/sign-in.js"}
)
"""The paths that answer without a token."""

log = structlog.get_logger(__name__)

_READING = frozenset({"GET", "HEAD", "OPTIONS"})


class Doorkeeper:
    """ASGI middleware that lets a request in only when its token has the scope.

    The metrics need the scope ``metrics``, reading needs ``read``, everything else ``write``.
    """

    def __init__(self, app: ASGIApp, sign_ins: SignInLimit) -> None:
        self._app = app
        self._sign_ins = sign_ins
        self._callers = Callers()

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket") or scope["path"] in OPEN_PATHS:
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        try:
            caller = await self._identify(connection)
            # Before the check of its scopes, so that the audit trail names the caller of a refused request.
            scope.setdefault("state", {})["caller"] = caller
            _demand(caller, _needed(scope))
            scope["state"]["is_let_in"] = functools.partial(self._is_let_in, connection)
        except Problem as problem:
            if problem.status == 401 and _opens_page(connection):
                await RedirectResponse(SIGN_IN, 303)(scope, receive, send)
                return
            await answer(problem)(scope, receive, send)
            return
        except DATABASE_AWAY as error:
            await answer(database_away(error))(scope, receive, send)
            return
        await self._app(scope, receive, send)

    async def _identify(self, connection: HTTPConnection) -> Caller:
        credential = _credential(connection)
        caller = await self._caller_of(credential)
        if caller is None:
            raise await self._refusal(connection, credential)
        if caller is auth.OPEN:
            _check_local(connection)
        else:
            check_host(connection)
        return caller

    async def _caller_of(self, credential: Credential | None) -> Caller | None:
        caller = self._callers.remembered(credential)
        if caller is None:
            caller = await to_thread.run_sync(self._callers.look_up, credential, limiter=_threads())
        return caller

    async def _is_let_in(self, connection: HTTPConnection) -> bool:
        """Return whether the token or session of a request that lasts is still valid."""
        try:
            return await self._caller_of(_credential(connection)) is not None
        except DATABASE_AWAY:
            # It holds nothing new for the request either.
            return True

    async def _refusal(self, connection: HTTPConnection, credential: Credential | None) -> Problem:
        if credential is None:
            return _unauthorised("This service needs an access token: send 'Authorization: Bearer <token>'.")
        if credential.is_session:
            # Nobody guesses an id of 256 random bits, and each page asks once more when its session has ended.
            return _unauthorised("The session of this browser has ended; sign in again.")
        address = connection.client.host if connection.client else ""
        await to_thread.run_sync(self._sign_ins.failed, address, limiter=_threads_of_failures())
        log.warning("sign_in_failed", address=address)
        return _unauthorised("This token is unknown, expired or revoked; ask for a new one.", 'error="invalid_token"')


def _credential(connection: HTTPConnection) -> Credential | None:
    token = bearer_token(connection)
    if token is not None:
        return Credential(auth.token_hash(token))
    session = session_id(connection)
    return None if session is None else Credential(auth.token_hash(session), is_session=True)


def _needed(scope: AsgiScope) -> Scope:
    """Return the scope that a request needs."""
    reads = scope.get("method") in _READING
    if reads and scope["path"] == METRICS:
        return Scope.METRICS
    # A session begins and ends with any token that may read.
    return Scope.READ if reads or scope["path"] == SESSION else Scope.WRITE


def _opens_page(connection: HTTPConnection) -> bool:
    headers = connection.headers
    is_page = not connection.scope["path"].startswith("/v1/") and "text/html" in headers.get("accept", "")
    return is_page and connection.scope.get("method") == "GET" and "authorization" not in headers


def bearer_token(connection: HTTPConnection) -> str | None:
    """Return the token of the header ``Authorization``; None without one."""
    scheme, _, credentials = connection.headers.get("authorization", "").partition(" ")
    return (credentials.strip() or None) if scheme.lower() == "bearer" else None


def _unauthorised(detail: str, challenge: str = "") -> Problem:
    return Problem(401, "unauthorized", detail, headers={"WWW-Authenticate": f"Bearer {challenge}".strip()})


def _check_local(connection: HTTPConnection) -> None:
    """Check that a request to an open service is local.

    The request must come from this machine and from the service's own pages, because any web page in the user's browser
    can reach an open service.
    """
    server = connection.scope.get("server")
    if server is None or not auth.is_loopback(str(server[0])):
        raise _unauthorised("This service has no access token yet; make one with 'fluoromap token create'.")
    if is_forwarded(connection):
        # The service cannot see for whom a proxy asks.
        raise Problem(
            403,
            "forwarded",
            "Without tokens this service answers no proxy; make a token with 'fluoromap token create' and send it.",
        )
    name = host_name(connection)
    if name is None or not auth.is_loopback(name):
        raise Problem(403, "foreign_host", "Without tokens this service answers only under localhost or 127.0.0.1.")
    origin = connection.headers.get("origin")
    allowed = origin is not None and origin.lower() in settings().allowed_origins
    site = connection.headers.get("sec-fetch-site", "none")
    if site not in ("same-origin", "none") and not allowed and not _is_navigation(connection):
        raise Problem(403, "foreign_origin", "Without tokens this service answers only to its own pages.")
    own = f"{connection.scope['scheme']}://{connection.headers['host']}".lower()
    if origin is not None and not allowed and origin.lower() != own:
        raise Problem(403, "foreign_origin", "Without tokens this service answers only to its own pages.")


def _is_navigation(connection: HTTPConnection) -> bool:
    """Return whether a person follows a link to this service.

    The page with the link cannot read the answer.
    """
    headers = connection.headers
    return (
        connection.scope.get("method") == "GET"
        and headers.get("sec-fetch-mode") == "navigate"
        and headers.get("sec-fetch-dest") == "document"
    )


@functools.cache
def _threads() -> CapacityLimiter:
    # Of its own, so that a request need not wait for the threads of other requests before it is even let in.
    return CapacityLimiter(8)


@functools.cache
def _threads_of_failures() -> CapacityLimiter:
    # Counting a wrong token may wait for a lock of the database. No valid token waits behind it.
    return CapacityLimiter(2)


def _demand(caller: Caller, scope: Scope) -> None:
    if not caller.may(scope):
        raise Problem(
            403,
            "forbidden",
            f"This token lacks the scope '{scope}'; use a token that has it.",
            headers={"WWW-Authenticate": f'Bearer error="insufficient_scope", scope="{scope}"'},
        )


# The doorkeeper has checked the token already; this declares the scheme in the OpenAPI document.
Token = Annotated[
    HTTPAuthorizationCredentials | None,
    Security(HTTPBearer(auto_error=False, description="A token made with 'fluoromap token create'.")),
]


def _caller_with(request: Request, scope: Scope) -> str:
    caller: Caller | None = getattr(request.state, "caller", None)
    if caller is None:
        raise _unauthorised("This service needs an access token: send 'Authorization: Bearer <token>'.")
    _demand(caller, scope)
    return caller.name


async def _reader(request: Request, _: Token) -> str:
    return _caller_with(request, Scope.READ)


async def _monitor(request: Request, _: Token) -> str:
    return _caller_with(request, Scope.METRICS)


async def _writer(request: Request, _: Token) -> str:
    return _caller_with(request, Scope.WRITE)


Reader = Annotated[str, Depends(_reader)]
"""The caller's name, "open" where the service needs no token; the caller may read."""

Monitor = Annotated[str, Depends(_monitor)]
"""The caller's name; the caller may at least read the metrics."""

Writer = Annotated[str, Depends(_writer)]
"""The caller's name; the caller may also change things."""
