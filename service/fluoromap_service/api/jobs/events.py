"""The route of a job's event stream."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Annotated

from fastapi import Depends, Header, Request
from fastapi.responses import StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT

from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.jobs.job_watch import JobWatch
from fluoromap_service.problem import Problem
from fluoromap_service.results.finished import job_of
from fluoromap_service.store.engine import reading

router = new_router(tags=["jobs"])

COMMENT_SECONDS = 15.0
"""Silence after which a comment keeps the connection open."""
CHECK_SECONDS = 5.0
"""Time over which a stream takes its token as valid, so that it does not ask the database for each event."""


class _EventStream(StreamingResponse):
    """A stream of server-sent events. FastAPI's own one would encode each event for each stream, which takes ten times as long."""

    media_type = "text/event-stream"


_EXAMPLE = (
    'event: stage\ndata: {"name": "segment", "subject": "1.2.826.0.1.3680043.8.498.1", "state": "running", "attempt": 1, '
    '"progress": 0.4, "reused": false}\nid: 17\n\n'
    'event: job\ndata: {"state": "succeeded", "error": null}\nid: 18\n\n'
)

LastEventId = Annotated[str | None, Header(alias="Last-Event-ID", description="The last id that the client received.")]


def _resume_after(last_event_id: LastEventId = None) -> int:
    if not last_event_id:
        return 0
    if not (last_event_id.isascii() and last_event_id.isdigit() and len(last_event_id) <= 18):
        detail = "Last-Event-ID is not an id of this stream; send the last id that you received."
        raise Problem(400, "malformed", detail, [("Last-Event-ID", "not a number")])
    return int(last_event_id)


def _existing(job_id: JobId) -> str:
    # A dependency, because the stream sends its status before its first line runs.
    with reading() as session:
        return job_of(session, job_id).id


@router.get(
    "/v1/jobs/{job_id}/events",
    summary="Follow a job",
    response_class=_EventStream,
    responses={
        200: {
            "content": {"text/event-stream": {"example": _EXAMPLE}},
            "description": "Events until the job has ended.",
        },
        **responses(400, 401, 403, 404),
    },
)
async def follow_job(
    job_id: Annotated[str, Depends(_existing)],
    request: Request,
    caller: Reader,
    after: Annotated[int, Depends(_resume_after)],
) -> _EventStream:
    """Send the events `job` (state, error) and `stage` (name, subject, state, attempt, progress, reused).

    The stream begins with the first event of the job, or after `Last-Event-ID`. Comments keep the connection open. The stream
    ends after the job. It ends earlier when the service ends; then connect again with `Last-Event-ID`. It also ends with the token.
    """
    watch: JobWatch = request.app.state.job_watch
    # For a proxy that would hold back the events.
    pieces = _pieces(watch, job_id, after, request.state.is_let_in)
    return _EventStream(pieces, headers={"Cache-Control": "no-cache", "X-Accel-Buffering": "no"})


async def _pieces(
    watch: JobWatch, job_id: str, after: int, is_let_in: Callable[[], Awaitable[bool]]
) -> AsyncIterator[bytes]:
    sent: set[int] = set()
    checked = time.monotonic()
    with watch.following(job_id, after) as follower:
        while True:
            try:
                async with asyncio.timeout(COMMENT_SECONDS):
                    news, is_silent = await follower.next(), False
            except TimeoutError:
                news, is_silent = None, True
            if time.monotonic() - checked >= CHECK_SECONDS:
                if not await is_let_in():
                    return
                checked = time.monotonic()
            if news is None:
                if not is_silent:
                    return
                yield KEEPALIVE_COMMENT
                continue
            fresh = {event.id: event.text for event in news.events if event.id > after and event.id not in sent}
            sent.update(fresh)
            if fresh:
                yield b"".join(fresh.values())
            if news.last:
                return
