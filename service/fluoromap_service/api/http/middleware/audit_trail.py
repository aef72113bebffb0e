"""The acts of callers, gathered from requests and written to the audit trail in batches.

One transaction for each read would make every reader wait for every writer. A batch is written at most ``FLUSH_SECONDS`` later,
and at the end of the service. The access log has each request at once.
"""

from __future__ import annotations

import threading

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fluoromap_service.api.http.middleware.access_log import NO_ROUTE, ids_of, method_of, route_of
from fluoromap_service.store import audit
from fluoromap_service.store.audit import Act
from fluoromap_service.store.engine import writing

FLUSH_SECONDS = 0.5

NOT_RECORDED = frozenset(
    {
        "/v1/health",
        "/v1/ready",
        "/v1/plugins",
        "/v1/openapi.json",
        "/metrics",
        NO_ROUTE,
        "/",
        "/sign-in",
        "/studies/{study_id}",
        "/assets/{name:path}",
    }
)
"""Routes that touch no study. The page of a study holds none of its data; it asks for them by other routes."""


class Acts:
    """Acts that wait to be written."""

    def __init__(self) -> None:
        self._waiting: list[Act] = []
        self._lock = threading.Lock()
        self._flushing = threading.Lock()

    def add(self, act: Act) -> None:
        """Add an act; equal reads of one batch are one entry."""
        with self._lock:
            if not (act.what.startswith("GET ") and act in self._waiting[-100:]):
                self._waiting.append(act)

    def flush(self) -> None:
        """Write all waiting acts to the trail.

        After a failure of the database they wait for the next call.
        """
        with self._flushing:
            with self._lock:
                batch = list(self._waiting)
            if not batch:
                return
            with writing() as session:
                audit.append(session, batch)
            with self._lock:
                del self._waiting[: len(batch)]


class AuditTrail:
    """ASGI middleware that notes who did what to which study."""

    def __init__(self, app: ASGIApp, acts: Acts) -> None:
        self._app = app
        self._acts = acts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        status, created = 500, None

        async def send_noted(message: Message) -> None:
            nonlocal status, created
            if message["type"] == "http.response.start":
                status = message["status"]
                collection, _, name = Headers(raw=message["headers"]).get("location", "").rpartition("/")
                created = {"/v1/studies": ("study", name), "/v1/jobs": ("job", name)}.get(collection)
            await send(message)

        try:
            await self._app(scope, receive, send_noted)
        finally:
            route, caller = route_of(scope), scope.get("state", {}).get("caller")
            if caller is not None and route not in NOT_RECORDED:
                ids = ids_of(scope)
                subject = {"study": ids.get("study_id"), "job": ids.get("job_id"), **dict([created] if created else [])}
                self._acts.add(Act(caller.name, f"{method_of(scope)} {route}"[:200], status=status, **subject))
