"""The event stream: order, resuming, ending."""

from __future__ import annotations

import asyncio
import json
import threading
from contextlib import ExitStack
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from finished_study import FinishedStudy
from sql_statements import sql_statements
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from fluoromap_service import auth
from fluoromap_service.api.http import stopping
from fluoromap_service.api.jobs import events, job_watch
from fluoromap_service.api.jobs.job_watch import Follower, JobWatch


def _parse(text: str) -> list[dict[str, Any]]:
    found = []
    for block in text.strip().split("\n\n"):
        lines = [line.split(": ", 1) for line in block.splitlines() if not line.startswith(":")]
        if lines:
            fields = dict(lines)
            found.append({"event": fields["event"], "id": int(fields["id"]), "data": json.loads(fields["data"])})
    return found


def _stream(client: TestClient, study: FinishedStudy, **headers: str) -> list[dict[str, Any]]:
    answer = client.get(f"/v1/jobs/{study.job_id}/events", headers=headers)
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/event-stream")
    return _parse(answer.text)


def test_everything_that_happened_and_the_end(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    events = _stream(client, study)
    assert [event["id"] for event in events] == sorted({event["id"] for event in events})
    assert (events[0]["event"], events[0]["data"]["state"]) == ("job", "queued")
    assert (events[-1]["event"], events[-1]["data"]) == ("job", {"state": "succeeded", "error": None})
    ended = [event["data"] for event in events if event["event"] == "stage" and event["data"]["state"] == "done"]
    assert len(ended) == 9
    assert set(ended[0]) == {"name", "subject", "state", "attempt", "progress", "reused"}


def test_the_stream_ends_with_the_token(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "CHECK_SECONDS", 0.0)
    auth.create_token("other", ["read", "write"])
    token = auth.create_token("reader", ["read"])
    revoked = threading.Event()

    async def revoke_first(follower: Follower, following: Any = Follower.next) -> Any:
        if not revoked.is_set():
            await asyncio.to_thread(auth.revoke_token, "reader")
            revoked.set()
        return await following(follower)

    monkeypatch.setattr(Follower, "next", revoke_first)
    study.finish()
    assert _stream(client, study, Authorization=f"Bearer {token}") == []
    assert client.get("/v1/studies", headers={"Authorization": f"Bearer {token}"}).status_code == 401


def test_resuming_gives_only_what_came_later(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    events = _stream(client, study)
    middle = events[len(events) // 2]["id"]
    assert _stream(client, study, **{"Last-Event-ID": str(middle)}) == [
        event for event in events if event["id"] > middle
    ]
    assert _stream(client, study, **{"Last-Event-ID": str(events[-1]["id"])}) == []


def test_the_stream_follows_a_running_job(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = threading.Event()
    deliver = job_watch._deliver

    def noticed(news: Any) -> None:
        deliver(news)
        looked.set()

    monkeypatch.setattr(job_watch, "_deliver", noticed)
    received: list[list[dict[str, Any]]] = []
    following = threading.Thread(target=lambda: received.append(_stream(client, study)))
    following.start()
    assert looked.wait(30)
    study.finish()
    following.join(60)
    ids = [event["id"] for event in received[0]]
    assert len(ids) == len(set(ids))
    assert received[0][-1]["data"]["state"] == "succeeded"


def test_what_is_committed_late_is_not_lost(
    application: FastAPI, client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lower id that appears after a higher one was sent, as two PostgreSQL transactions can make it."""
    study.finish()
    expected = {event["id"] for event in _stream(client, study)}
    marks, events_after = job_watch._marks, job_watch._events_after
    looks: list[str] = []

    def running(session: Session, jobs: list[str]) -> dict[str, Any]:
        looks.append("look")
        found = marks(session, jobs)
        return (
            {job: ("running", number, *mark[2:]) for number, (job, mark) in enumerate(found.items())}
            if len(looks) == 1
            else found
        )

    def delayed(session: Session, after: int, job_id: str | None = None) -> Any:
        found = events_after(session, after, job_id)
        return found[1:] if len(looks) == 1 else found

    # A thread that has not ended yet has seen the event.
    application.state.job_watch = JobWatch()
    monkeypatch.setattr(job_watch, "_marks", running)
    monkeypatch.setattr(job_watch, "_events_after", delayed)
    monkeypatch.setattr(job_watch, "last_change", lambda: None)
    assert {event["id"] for event in _stream(client, study)} == expected
    assert len(looks) > 1


def test_the_stream_outlives_a_database_that_is_away_for_a_moment(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    study.finish()
    expected = _stream(client, study)
    marks = job_watch._marks
    looks: list[str] = []

    def away(session: Session, jobs: list[str]) -> Any:
        looks.append("look")
        if len(looks) < 3:
            raise OperationalError("SELECT", {}, Exception("the connection is closed"))
        return marks(session, jobs)

    monkeypatch.setattr(job_watch, "_marks", away)
    assert _stream(client, study) == expected


async def _statements(streams: int, job_id: str) -> tuple[int, int]:
    """Return the number of statements of the first look, and of the next one."""
    followers, looks = [Follower(job_id, 0) for _ in range(streams)], job_watch._Looks()
    numbers = []
    for _ in range(2):
        with sql_statements() as found:
            looks.look(followers)
        numbers.append(len(found))
    return numbers[0], numbers[1]


@pytest.mark.parametrize("streams", [1, 300])
def test_a_stream_costs_no_query(study: FinishedStudy, streams: int) -> None:
    assert asyncio.run(_statements(streams, study.job_id)) == (4, 2)


async def _follow(job_id: str, streams: int) -> set[str]:
    watch, before = JobWatch(), set(threading.enumerate())
    with ExitStack() as stack:
        followers = [stack.enter_context(watch.following(job_id, 0)) for _ in range(streams)]
        news = await asyncio.gather(*(follower.next() for follower in followers))
        assert all(each is not None and each.state == "queued" for each in news)
        return {thread.name for thread in threading.enumerate() if thread not in before}


def test_a_stream_costs_no_thread(study: FinishedStudy) -> None:
    assert asyncio.run(_follow(study.job_id, 300)) == {"job-watch"}


def test_the_stream_of_a_running_job_ends_with_the_service(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stopping, "_stopping", threading.Event())
    stopping.begin()
    events = _stream(client, study)
    assert events[-1]["data"]["state"] == "queued"


@pytest.mark.parametrize("value", ["abc", "-1", "1" * 30])
def test_an_id_of_no_event(client: TestClient, study: FinishedStudy, value: str) -> None:
    answer = client.get(f"/v1/jobs/{study.job_id}/events", headers={"Last-Event-ID": value})
    assert (answer.status_code, answer.json()["code"]) == (400, "malformed")


def test_a_job_that_does_not_exist_has_no_stream(client: TestClient) -> None:
    answer = client.get("/v1/jobs/nothing/events")
    assert (answer.status_code, answer.headers["content-type"]) == (404, "application/problem+json")
