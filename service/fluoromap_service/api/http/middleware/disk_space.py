"""Requests that write are refused before the disk is full, so that running jobs can still store their results."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from fluoromap_service.api.http.problems import answer, no_space
from fluoromap_service.store import disk
from fluoromap_service.store.disk import NoSpace

_WRITING = frozenset({"POST", "PUT", "PATCH"})


class DiskSpace:
    """ASGI middleware that answers 507 to a request whose body would fill the reserve of the disk.

    Deleting a study and cancelling a job stay possible.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] in _WRITING and not scope["path"].endswith(":cancel"):
            declared = Headers(scope=scope).get("content-length", "")
            try:
                disk.check_room(int(declared) if declared.isdecimal() else 0)
            except NoSpace:
                await answer(no_space())(scope, receive, send)
                return
        await self._app(scope, receive, send)
