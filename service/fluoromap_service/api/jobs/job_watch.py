"""The watch over jobs: one thread of the process looks at the database for all event streams and waiting requests.

A follower costs neither a thread nor a query. A look takes two queries, whatever the number of jobs and followers: the marks of
the watched jobs, and the newest events. The events from before a stream began take one query for each job.
"""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import structlog
from fastapi.sse import format_sse_event
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from fluoromap_service.api.http import stopping
from fluoromap_service.api.jobs.job_answers import etag_of
from fluoromap_service.store.changes import Change, last_change
from fluoromap_service.store.engine import DATABASE_AWAY, reading
from fluoromap_service.store.models import ENDED_JOB, Event, Job, Study

POLL_SECONDS = 0.25
"""Time between two looks at a database that cannot say whether it has changed."""
LOOK_SECONDS = 0.05
"""Time between two questions whether the database has changed, where they cost no query."""
FOLLOWER_SECONDS = 0.001
"""Time that each follower adds to that time. Sending a piece takes about a tenth of it; the rest is for other requests."""
OVERLAP = 100
"""Events get their ids before their commit, so an id lower than the newest by up to this number may still appear."""

Mark = tuple[Any, ...]
"""State, version, newest event and study's last change of a job: it changes with everything that an answer shows."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class StreamEvent:
    """An event of a job as all streams send it."""

    id: int
    job_id: str
    text: bytes

    @classmethod
    def of(cls, event: Event) -> StreamEvent:
        """Encode an event once for all streams."""
        data = json.dumps(event.data)
        return cls(event.id, event.job_id, format_sse_event(data_str=data, event=event.kind, id=str(event.id)))


@dataclass(frozen=True, slots=True)
class News:
    """The state of a job, and its events that the follower may not have.

    Parameters
    ----------
    state : str or None
        None when the job no longer exists.
    etag : str
        Entity tag of the job; empty for a stream.
    events : sequence of StreamEvent
        In the order of their ids.
    """

    state: str | None
    etag: str
    events: Sequence[StreamEvent]

    @property
    def last(self) -> bool:
        """Whether no news of this job follow."""
        return self.state is None or self.state in ENDED_JOB


class Follower:
    """One stream or one waiting request."""

    def __init__(self, job_id: str, after: int | None) -> None:
        self.job_id = job_id
        self.after = after
        self.is_new = True
        self.loop = asyncio.get_running_loop()
        self.arrived: asyncio.Queue[News | None] = asyncio.Queue()

    async def next(self) -> News | None:
        """Wait for the next news; None when the service ends.

        The first ones come at once.
        """
        return await self.arrived.get()


class JobWatch:
    """The watch of one process. Its thread runs only while there are followers."""

    def __init__(self) -> None:
        self._followers: set[Follower] = set()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    @contextmanager
    def following(self, job_id: str, after: int | None = None) -> Iterator[Follower]:
        """Follow a job.

        Parameters
        ----------
        job_id : str
        after : int, optional
            The stream's last event so far, 0 for none; without it the follower gets entity tags in place of events.
        """
        follower = Follower(job_id, after)
        with self._lock:
            self._followers.add(follower)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="job-watch", daemon=True)
                self._thread.start()
        try:
            yield follower
        finally:
            with self._lock:
                self._followers.discard(follower)

    def _run(self) -> None:
        looks, seen_change, looked = _Looks(), None, 0.0
        while True:
            with self._lock:
                if not self._followers:
                    self._thread = None
                    return
                followers = tuple(self._followers)
            change: Change | None = last_change()
            waited = time.monotonic() - looked
            due = change != seen_change if change is not None else waited >= POLL_SECONDS
            if due or any(follower.is_new for follower in followers):
                try:
                    _deliver(looks.look(followers))
                    seen_change = change
                except DATABASE_AWAY:
                    # The followers wait until the database is back.
                    seen_change = None
                except Exception as error:
                    log.error("jobs_not_watched", error=type(error).__name__, exc_info=error)
                    seen_change = None
                looked = time.monotonic()
            if stopping.begun():
                _deliver([(follower, None) for follower in followers])
            time.sleep(LOOK_SECONDS + FOLLOWER_SECONDS * len(followers))


class _Looks:
    """The looks of one run of the thread, and what the earlier ones have found."""

    def __init__(self) -> None:
        self._marks: dict[str, Mark] = {}
        self._newest: int | None = None
        self._recent: set[int] = set()

    def look(self, followers: Sequence[Follower]) -> Sequence[tuple[Follower, News]]:
        """Return the news for the followers that have any."""
        by_job: dict[str, list[Follower]] = defaultdict(list)
        for follower in followers:
            by_job[follower.job_id].append(follower)
        with reading() as session:
            # The marks first: the events below, or those of the next look, include all that were committed after them.
            marks = _marks(session, list(by_job))
            newest = self._newest if self._newest is not None else _newest_event(session)
            recent = [event for event in _events_after(session, newest - OVERLAP) if event.id not in self._recent]
            news = [
                pair for job_id, group in by_job.items() for pair in self._news(session, job_id, group, marks, recent)
            ]
        self._marks = marks
        self._newest = max([newest, *(event.id for event in recent)])
        self._recent = {number for number in self._recent if number > self._newest - OVERLAP}
        self._recent |= {event.id for event in recent}
        for follower in followers:
            follower.is_new = False
        return news

    def _news(
        self, session: Session, job_id: str, group: list[Follower], marks: dict[str, Mark], recent: list[StreamEvent]
    ) -> Iterator[tuple[Follower, News]]:
        mark = marks.get(job_id)
        state = None if mark is None else str(mark[0])
        changed = mark != self._marks.get(job_id)
        events = [event for event in recent if event.job_id == job_id]
        addressed = [follower for follower in group if changed or events or follower.is_new]
        starts = [follower.after for follower in addressed if follower.is_new and follower.after is not None]
        earlier = _events_after(session, min(starts), job_id) if starts and mark is not None else []
        waiting = mark is not None and any(follower.after is None for follower in addressed)
        etag = etag_of(session, session.get_one(Job, job_id)) if waiting else ""
        for follower in addressed:
            if follower.after is None:
                yield follower, News(state, etag, ())
            else:
                yield follower, News(state, "", [*earlier, *events] if follower.is_new else events)


def _marks(session: Session, job_ids: list[str]) -> dict[str, Mark]:
    newest = select(func.max(Event.id)).where(Event.job_id == Job.id).correlate(Job).scalar_subquery()
    query = select(Job.id, Job.state, Job.version, newest, Study.updated).join(Study, Study.id == Job.study_id)
    return {job_id: tuple(mark) for job_id, *mark in session.execute(query.where(Job.id.in_(job_ids)))}


def _newest_event(session: Session) -> int:
    return session.scalar(select(func.max(Event.id))) or 0


def _events_after(session: Session, after: int, job_id: str | None = None) -> list[StreamEvent]:
    query = select(Event).where(Event.id > after).order_by(Event.id)
    found = session.scalars(query if job_id is None else query.where(Event.job_id == job_id))
    return [StreamEvent.of(event) for event in found]


def _deliver(news: Sequence[tuple[Follower, News | None]]) -> None:
    """Hand over news, with one call for each event loop."""
    by_loop: dict[asyncio.AbstractEventLoop, list[tuple[Follower, News | None]]] = defaultdict(list)
    for pair in news:
        by_loop[pair[0].loop].append(pair)
    for loop, pairs in by_loop.items():
        try:
            loop.call_soon_threadsafe(_put, pairs)
        except RuntimeError:
            # The loop has ended, and its followers with it.
            continue


def _put(pairs: Sequence[tuple[Follower, News | None]]) -> None:
    for follower, news in pairs:
        follower.arrived.put_nowait(news)
