"""Long work for one caller: only some at the same time.

A large download holds a file, a thread or space on the disk; a picture or a search for electrodes holds a thread and a process.
Requests beyond them wait without a thread, so that one reader with many requests holds nobody else up.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from fastapi import Depends, Request
from starlette.types import ASGIApp, Receive, Scope, Send

from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

WAIT_SECONDS = 30.0
"""Longest time that a download waits for an earlier one of the same caller. Viewers ask for many instances at once."""
RETRY_SECONDS = 10
PICTURES = 2
"""Pictures, and frames whose electrodes the service seeks, of one caller at the same time: more processes draw none."""


class DownloadLimit:
    """ASGI middleware that counts the long work for each caller, from the start of a route to the end of its answer."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._downloads: dict[str, asyncio.Semaphore] = {}
        self._pictures: dict[str, asyncio.Semaphore] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        taken: list[asyncio.Semaphore] = []

        async def take(all_places: dict[str, asyncio.Semaphore], number: int, refusal: Callable[[], Problem]) -> None:
            name = scope["state"]["caller"].name
            places = all_places.setdefault(name, asyncio.Semaphore(number))
            try:
                async with asyncio.timeout(WAIT_SECONDS):
                    await places.acquire()
            except TimeoutError:
                raise refusal() from None
            taken.append(places)

        state = scope.setdefault("state", {})
        state["take_download"] = lambda: take(self._downloads, settings().downloads, _too_many)
        state["take_picture"] = lambda: take(self._pictures, PICTURES, _too_many_pictures)
        try:
            await self._app(scope, receive, send)
        finally:
            for places in taken:
                places.release()


def _too_many() -> Problem:
    detail = f"This token downloads {settings().downloads} large files already; wait until one of them has ended."
    return Problem(429, "too_many_downloads", detail, headers={"Retry-After": str(RETRY_SECONDS)})


def _too_many_pictures() -> Problem:
    detail = f"The service draws {PICTURES} pictures for this token already; send the request again."
    return Problem(429, "busy", detail, headers={"Retry-After": str(RETRY_SECONDS)})


async def _take(request: Request) -> None:
    await request.state.take_download()


LARGE_DOWNLOAD = Depends(_take)
"""A dependency of the routes that send whole runs, archives or long tables."""


async def _take_picture(request: Request) -> None:
    await request.state.take_picture()


PICTURE = Depends(_take_picture)
"""A dependency of the routes that draw a frame, or seek its electrodes."""
