"""The server's side of a connection: silent ones end, and even a broken request gets a problem document."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import h11
from starlette.datastructures import MutableHeaders
from uvicorn.protocols.http.h11_impl import H11Protocol

from fluoromap_service.api.http.middleware.security_headers import add_security_headers
from fluoromap_service.api.http.problems import MEDIA_TYPE, document
from fluoromap_service.problem import Problem

HEADER_SECONDS = 10.0
"""Longest time from the start of a connection, or of a further request on it, to the end of the request's header."""


WRITE_SECONDS = 60.0
SLOWEST_BYTES = 480 * 2**10
"""A client takes this much of a waiting answer in ``WRITE_SECONDS``, or what is left of it: 8 KiB a second."""


class TimedConnection(H11Protocol):
    """A connection that closes when no whole request header arrives in time, or when the client hardly takes the answer.

    uvicorn limits the time between two requests only. A client could hold thousands of connections that never send one, or keep
    answers, with the files and threads behind them, for days.
    """

    _deadline: asyncio.TimerHandle | None = None
    _progress: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Take bytes; the time for the header begins with the first one."""
        if self._deadline is None and self.conn.their_state is h11.IDLE:
            self._wait()
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._stop_waiting()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the deadlines."""
        self._stop_waiting()
        self._stop_watching()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Stop the answer until the client has taken the waiting part.

        The connection watches that it does.
        """
        super().pause_writing()
        self._watch()

    def resume_writing(self) -> None:
        """Continue the answer."""
        self._stop_watching()
        super().resume_writing()

    def send_400_response(self, msg: str) -> None:
        """Answer a request that is no HTTP."""
        problem = Problem(400, "malformed", "The request is no valid HTTP/1.1; correct its header.")
        headers = MutableHeaders({"Content-Type": MEDIA_TYPE, "Connection": "close"})
        add_security_headers(headers)
        body = json.dumps(document(problem)).encode()
        headers["Content-Length"] = str(len(body))
        for event in (
            h11.Response(status_code=400, headers=headers.raw, reason=b"Bad Request"),
            h11.Data(data=body),
            h11.EndOfMessage(),
        ):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def _wait(self) -> None:
        self._deadline = self.loop.call_later(HEADER_SECONDS, self._give_up)

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _watch(self) -> None:
        self._stop_watching()
        left = self.transport.get_write_buffer_size()
        self._progress = self.loop.call_later(WRITE_SECONDS, self._check_progress, left)

    def _stop_watching(self) -> None:
        if self._progress is not None:
            self._progress.cancel()
            self._progress = None

    def _check_progress(self, left: int) -> None:
        if left - self.transport.get_write_buffer_size() < SLOWEST_BYTES:
            # Not close: that would wait until the client has taken the rest.
            self.transport.abort()
        else:
            self._watch()

    def _give_up(self) -> None:
        self._deadline = None
        if self.transport is not None and not self.transport.is_closing():
            self.transport.close()
