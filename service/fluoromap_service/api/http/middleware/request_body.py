"""The end of a request body: it arrives in time, and an answer that comes before it closes the connection properly."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

SILENCE_SECONDS = 30.0
"""Longest time between two parts of a body."""

DRAIN_SECONDS = 5.0
DRAIN_BYTES = 64 * 2**20
"""Limits for the rest of a body that nobody reads."""


class RequestBody:
    """ASGI middleware that bounds the wait for a body, and reads the rest of a refused one.

    A client that sends a long body reads the answer only afterwards. A connection that closes before that would lose the
    answer, and a connection that stays open would take the rest of the body for the next request.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        ended = headers.get("content-length", "0") == "0" and "transfer-encoding" not in headers
        closing = False

        async def receive_in_time() -> Message:
            nonlocal ended
            if ended:
                return await receive()
            try:
                async with asyncio.timeout(SILENCE_SECONDS):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, "The body did not arrive in time; send the request again.") from None
            ended = message["type"] == "http.disconnect" or not message.get("more_body", False)
            return message

        async def drain() -> None:
            length = 0
            with suppress(TimeoutError, HTTPException):
                async with asyncio.timeout(DRAIN_SECONDS):
                    while not ended and length < DRAIN_BYTES:
                        length += len((await receive_in_time()).get("body", b""))

        async def send_and_close(message: Message) -> None:
            nonlocal closing
            if message["type"] == "http.response.start" and not ended:
                closing = True
                MutableHeaders(scope=message)["Connection"] = "close"
            if closing and message["type"] == "http.response.body" and not message.get("more_body", False):
                await send({**message, "more_body": True})
                await drain()
                message = {"type": "http.response.body", "body": b""}
            await send(message)

        await self._app(scope, receive_in_time, send_and_close)
