"""Large downloads of one caller: only some at the same time, because each holds a file, a thread or space on the disk."""

from __future__ import annotations

import asyncio

from fastapi import Depends, Request
from starlette.types import ASGIApp, Receive, Scope, Send

from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

WAIT_SECONDS = 30.0
"""Longest time that a download waits for an earlier one of the same caller. Viewers ask for many instances at once."""
RETRY_SECONDS = 10


class DownloadLimit:
    """ASGI middleware that counts the large downloads of each caller, from the start of a route to the end of its answer."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._places: dict[str, asyncio.Semaphore] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        taken: list[asyncio.Semaphore] = []

        async def take() -> None:
            name = scope["state"]["caller"].name
            places = self._places.setdefault(name, asyncio.Semaphore(settings().downloads))
            try:
                async with asyncio.timeout(WAIT_SECONDS):
                    await places.acquire()
            except TimeoutError:
                raise _too_many() from None
            taken.append(places)

        scope.setdefault("state", {})["take_download"] = take
        try:
            await self._app(scope, receive, send)
        finally:
            for places in taken:
                places.release()


def _too_many() -> Problem:
    detail = f"This token downloads {settings().downloads} large files already; wait until one of them has ended."
    return Problem(429, "too_many_downloads", detail, headers={"Retry-After": str(RETRY_SECONDS)})


async def _take(request: Request) -> None:
    await request.state.take_download()


LARGE_DOWNLOAD = Depends(_take)
"""A dependency of the routes that send whole runs, archives or long tables."""
