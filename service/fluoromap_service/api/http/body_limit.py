"""How much of a request is taken in, whether or not it says its length."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fluoromap_service.api.http.problems import answer
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

TEXT_BYTES = 16 * 2**20
"""Largest JSON or CSV body: those are held in memory."""

_STREAMED = ("multipart/", "application/dicom")


class TooLarge(HTTPException):
    """The body goes on after the limit. An HTTPException, as FastAPI calls any other error of reading a body malformed."""

    def __init__(self, limit: int) -> None:
        super().__init__(413, too_large(limit).detail)
        self.problem = too_large(limit)


def too_large(limit: int) -> Problem:
    return Problem(413, "too_large", f"The request body is larger than {limit} bytes; send fewer files at a time.")


class BodyLimit:
    """ASGI middleware that stops reading a body at the limit for its kind."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        limit = settings().max_upload_bytes
        if not headers.get("content-type", "").lower().startswith(_STREAMED):
            limit = min(limit, TEXT_BYTES)
        declared = headers.get("content-length", "")
        if declared.isdecimal() and int(declared) > limit:
            await answer(too_large(limit))(scope, receive, send)
            return
        taken = 0

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > limit:
                raise TooLarge(limit)
            return message

        await self._app(scope, counted, send)
