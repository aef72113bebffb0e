"""The acts of callers, gathered from requests and written to the audit trail in batches.

One transaction for each read would make every reader wait for every writer. A batch is written at most ``FLUSH_SECONDS`` later,
and at the end of the service. The access log has each request at once.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from starlette.datastructures import Headers
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fluoromap_service.api.http.middleware.access_log import NO_ROUTE, ids_of, method_of, route_of
from fluoromap_service.store import audit
from fluoromap_service.store.audit import Act
from fluoromap_service.store.engine import writing

FLUSH_SECONDS = 0.5

REFUSAL_SECONDS = 60.0
"""Time over which equal refusals are one entry."""
MOST_REFUSALS = 100
"""Most entries of refusals in this time."""
OTHERS = "other addresses"
"""The sender of the refused requests beyond them."""

REFUSALS = frozenset({401, 403, 429})
"""The answers that say no to a caller."""

Key = TypeVar("Key")

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

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._serial = itertools.count(1)
        self._waiting: dict[tuple[Act, int], int] = {}
        """How often each act happened. Equal reads have the number 0, so that they are one entry; other acts have their own."""
        self._refused: dict[Act, int] = {}
        self._refused_since = clock()
        self._lock = threading.Lock()
        self._flushing = threading.Lock()

    def add(self, act: Act) -> None:
        """Add an act.

        Equal reads of one batch are one entry with their number.
        """
        with self._lock:
            key = act, 0 if act.what.startswith("GET ") else next(self._serial)
            self._waiting[key] = self._waiting.get(key, 0) + 1

    def refuse(self, act: Act) -> None:
        """Add a refused request.

        Equal ones of a minute are one entry with their number. When more than ``MOST_REFUSALS`` differ, the others are counted
        together, so that a flood of refused requests cannot fill the table.
        """
        with self._lock:
            if act not in self._refused and len(self._refused) >= MOST_REFUSALS:
                act = Act(OTHERS, "refused requests", status=act.status)
            self._refused[act] = self._refused.get(act, 0) + 1

    def flush(self, *, ending: bool = False) -> None:
        """Write all waiting acts to the trail, and the refusals of each past minute.

        After a failure of the database they wait for the next call. At the end of the service nothing waits for its minute.
        """
        with self._flushing:
            with self._lock:
                waiting, refused, since = self._waiting, dict[Act, int](), self._refused_since
                if ending or self._clock() - since >= REFUSAL_SECONDS:
                    refused, self._refused, self._refused_since = self._refused, {}, self._clock()
                self._waiting = {}
            batch = [replace(act, times=times) for (act, _), times in waiting.items()]
            batch += [replace(act, times=times) for act, times in refused.items()]
            if not batch:
                return
            try:
                with writing() as session:
                    audit.append(session, batch)
            except BaseException:
                with self._lock:
                    self._waiting = _sum(waiting, self._waiting)
                    self._refused = _sum(refused, self._refused)
                    self._refused_since = since
                raise


def _sum(first: dict[Key, int], second: dict[Key, int]) -> dict[Key, int]:
    return {key: first.get(key, 0) + second.get(key, 0) for key in (*first, *second)}


class AuditTrail:
    """ASGI middleware that notes who did what to which study, and who was refused.

    It lies around the doorkeeper, because a refused request passes no further.
    """

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
            self._note(scope, status, dict([created] if created else []))

    def _note(self, scope: Scope, status: int, created: dict[str, str]) -> None:
        caller = scope.get("state", {}).get("caller")
        if status in REFUSALS:
            _find_route(scope)
            client = scope.get("client")
            who = f"address {client[0] if client else 'unknown'}" if caller is None else caller.name
            self._acts.refuse(_act(scope, who, status, created))
        elif caller is not None and route_of(scope) not in NOT_RECORDED:
            self._acts.add(_act(scope, caller.name, status, created))


def _act(scope: Scope, who: str, status: int, created: dict[str, str]) -> Act:
    ids, route = ids_of(scope), route_of(scope)
    subject = {"study": ids.get("study_id"), "job": ids.get("job_id")} | created
    dicom_study = scope.get("path_params", {}).get("study_uid") if route.startswith("/dicom-web/") else None
    what = f"{method_of(scope)} {route}"[:200]
    return Act(who[:100], what, subject["study"], subject["job"], status, dicom_study)


def _find_route(scope: Scope) -> None:
    """Find the route of a request that the doorkeeper has refused."""
    if "route" in scope or "app" not in scope:
        return
    for route in scope["app"].routes:
        match, found = route.matches(scope)
        if match is Match.FULL:
            scope.update(found, route=route)
            return
