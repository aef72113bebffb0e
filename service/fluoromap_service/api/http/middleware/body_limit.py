"""The largest request body that the service reads."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fluoromap_service.api.http.problems import answer
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

TEXT_BYTES = 16 * 2**20
"""Largest JSON or CSV body: the service holds it in memory."""

_STREAMED = ("multipart/", "application/dicom")


class BodyLimit:
    """ASGI middleware that stops reading a body at the limit for its content type.

    It counts the bytes that arrive, so a wrong or missing Content-Length does not matter.
    """

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
            await answer(_too_large(limit))(scope, receive, send)
            return
        received_bytes = 0

        async def receive_up_to_limit() -> Message:
            nonlocal received_bytes
            message = await receive()
            received_bytes += len(message.get("body", b""))
            if received_bytes > limit:
                # FastAPI reports every other exception during the reading of a body as 400 "malformed".
                raise HTTPException(413, _too_large(limit).detail)
            return message

        await self._app(scope, receive_up_to_limit, send)


def _too_large(limit: int) -> Problem:
    return Problem(413, "too_large", f"The request body is larger than {limit} bytes; send fewer files at a time.")
