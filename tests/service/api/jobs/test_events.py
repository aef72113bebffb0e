"""The event stream: order, resuming, ending."""

from __future__ import annotations

import json
import threading
from typing import Any

import pytest
from fastapi.testclient import TestClient
from finished_study import FinishedStudy
from sqlalchemy.exc import OperationalError

from fluoromap_service.api.http import stopping
from fluoromap_service.api.jobs import events as event_routes


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
    news = event_routes._new_events

    def noticed(job_id: str, after: int) -> Any:
        found = news(job_id, after)
        looked.set()
        return found

    monkeypatch.setattr(event_routes, "_new_events", noticed)
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
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lower id that appears after a higher one was sent, as two PostgreSQL transactions can make it."""
    study.finish()
    news = event_routes._new_events
    looks: list[int] = []

    def delayed(job_id: str, after: int) -> Any:
        ended, found = news(job_id, after)
        looks.append(after)
        return (False, found[1:]) if len(looks) == 1 else (ended, found)

    expected = {event["id"] for event in _stream(client, study)}
    monkeypatch.setattr(event_routes, "_new_events", delayed)
    assert {event["id"] for event in _stream(client, study)} == expected


def test_the_stream_outlives_a_database_that_is_away_for_a_moment(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    study.finish()
    expected = _stream(client, study)
    news = event_routes._new_events
    looks: list[int] = []

    def away(job_id: str, after: int) -> Any:
        looks.append(after)
        if len(looks) < 3:
            raise OperationalError("SELECT", {}, Exception("the connection is closed"))
        return news(job_id, after)

    monkeypatch.setattr(event_routes, "_new_events", away)
    assert _stream(client, study) == expected


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
