"""One JSON line for each request, without patient data, and one for each unexpected error.

A path can contain a SOP Instance UID or a site's name, so the line has the route's template in place of the path.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from typing import Any

import structlog
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fluoromap_service.api.http.problems import answer
from fluoromap_service.problem import Problem

NO_ROUTE = "(none)"
"""Route of a request that no route answers, or that was refused before."""

log = structlog.get_logger(__name__)


class RequestCounts:
    """Number and duration of the requests of this process, by method, route and status."""

    def __init__(self) -> None:
        self.requests: Counter[tuple[str, str, int]] = Counter()
        self.seconds: Counter[tuple[str, str]] = Counter()

    def add(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one request."""
        self.requests[method, route, status] += 1
        self.seconds[method, route] += seconds  # type: ignore[assignment]


def route_of(scope: Scope) -> str:
    """Return the template of the request's route."""
    return str(getattr(scope.get("route"), "path", NO_ROUTE))


def ids_of(scope: Scope) -> dict[str, str]:
    """Return the ids of study and job in the path.

    Other text in their place is left out, because it may be a name.
    """
    ids = {name: str(scope.get("path_params", {}).get(name)) for name in ("study_id", "job_id")}
    return {name: value for name, value in ids.items() if re.fullmatch("[0-9a-f]{32}", value)}


def method_of(scope: Scope) -> str:
    """Return the method of the request."""
    method = str(scope["method"])
    return method if method in ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS") else "other"


class AccessLog:
    """ASGI middleware that logs and counts requests, and answers unexpected errors with 500.

    The error ends here. The server would log it a second time, and not as JSON.
    """

    def __init__(self, app: ASGIApp, counts: RequestCounts) -> None:
        self._app = app
        self._counts = counts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status, sent_bytes = time.perf_counter(), 0, 0

        async def send_counted(message: Message) -> None:
            nonlocal status, sent_bytes
            if message["type"] == "http.response.start":
                status = message["status"]
            sent_bytes += len(message.get("body", b""))
            await send(message)

        try:
            await self._app(scope, receive, send_counted)
        except Exception as error:
            log.error("unexpected_error", **_request(scope), error=type(error).__name__, exc_info=error)
            if status == 0:
                problem = Problem(500, "internal", "The service failed and changed nothing; see its log.")
                await answer(problem)(scope, receive, send_counted)
        finally:
            seconds = time.perf_counter() - start
            self._counts.add(method_of(scope), route_of(scope), status, seconds)
            caller = scope.get("state", {}).get("caller")
            log.info(
                "request",
                **_request(scope),
                status=status,
                ms=round(1000 * seconds, 1),
                bytes=sent_bytes,
                caller=None if caller is None else caller.name,
            )


def _request(scope: Scope) -> dict[str, Any]:
    return {"method": method_of(scope), "path": route_of(scope), **ids_of(scope)}
