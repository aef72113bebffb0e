"""The route of a job's event stream."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable
from typing import Annotated

from fastapi import Depends, Header
from fastapi.sse import EventSourceResponse, ServerSentEvent
from sqlalchemy import select
from starlette.concurrency import run_in_threadpool

from fluoromap_service.api.http import stopping
from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.problem import Problem
from fluoromap_service.results.finished import job_of
from fluoromap_service.store.changes import Change, last_change
from fluoromap_service.store.engine import DATABASE_AWAY, reading
from fluoromap_service.store.models import ENDED_JOB, Event

router = new_router(tags=["jobs"])

POLL_SECONDS = 0.25
"""Longest time between two queries for new events."""
LOOKS = 5
"""How often within that time a stream looks whether the database has changed, where this costs no query."""
OVERLAP = 100
"""Events get their ids before their commit, so an id lower than the newest by up to this number may still appear."""

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
    response_class=EventSourceResponse,
    responses={
        200: {
            "content": {"text/event-stream": {"example": _EXAMPLE}},
            "description": "Events until the job has ended.",
        },
        **responses(400, 401, 403, 404),
    },
)
async def follow_job(
    job_id: Annotated[str, Depends(_existing)], caller: Reader, after: Annotated[int, Depends(_resume_after)]
) -> AsyncIterable[ServerSentEvent]:
    """Send the events `job` (state, error) and `stage` (name, subject, state, attempt, progress, reused).

    The stream begins with the first event of the job, or after `Last-Event-ID`. Comments keep the connection open. The stream
    ends after the job. It ends earlier when the service ends; then connect again with `Last-Event-ID`.
    """
    sent: set[int] = set()
    newest = after
    while True:
        change = last_change()
        try:
            ended, found = await run_in_threadpool(_new_events, job_id, max(after, newest - OVERLAP))
        except DATABASE_AWAY:
            # The status is sent already. The stream goes on when the database is back.
            ended, found = False, []
        for event in found:
            if event.id not in sent:
                sent.add(event.id)
                newest = max(newest, event.id)
                yield ServerSentEvent(data=event.data, event=event.kind, id=str(event.id))
        if ended or stopping.begun():
            return
        await _until_changed(change)


async def _until_changed(change: Change | None) -> None:
    for _ in range(LOOKS):
        await asyncio.sleep(POLL_SECONDS / LOOKS)
        if change is not None and change != last_change():
            return


def _new_events(job_id: str, after: int) -> tuple[bool, list[Event]]:
    with reading() as session:
        # The state first: the query below, or the next round, finds every event that is committed after it.
        ended = job_of(session, job_id).state in ENDED_JOB
        query = select(Event).where(Event.job_id == job_id, Event.id > after).order_by(Event.id)
        return ended, list(session.scalars(query))
