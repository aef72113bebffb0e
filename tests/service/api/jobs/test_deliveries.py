"""The routes of deliveries and their metrics."""

from __future__ import annotations

import re

import pytest
from fastapi.testclient import TestClient
from finished_study import FinishedStudy

from fluoromap_service.deliveries import outbox
from fluoromap_service.deliveries.outbox import Claim, Failure
from fluoromap_service.store.engine import writing
from fluoromap_service.store.models import ObjectState


@pytest.fixture
def held(study: FinishedStudy) -> Claim:
    """A claimed delivery of a finished job, one of whose two objects has arrived."""
    with writing() as session:
        outbox.register(session, "pacs")
    study.finish()
    with writing() as session:
        outbox.plan(session, "pacs", ["succeeded"])
        claim = outbox.claim(session, "pacs", "tester")
        assert claim is not None
        outbox.set_objects(session, claim, {"1.2.3": "report.dcm", "1.2.4": "chamber.dcm"})
        outbox.set_object_state(session, claim, "1.2.3", ObjectState.DELIVERED)
    return claim


def give_up(held: Claim) -> None:
    failure = Failure("unreachable", "The target does not answer.")
    with writing() as session:
        assert outbox.fail(session, held, failure, wait_seconds=None, give_up_days=7)


def test_state_objects_and_history(client: TestClient, held: Claim) -> None:
    give_up(held)
    (listed,) = client.get("/v1/deliveries", params={"job": held.job_id, "state": "failed", "target": "pacs"}).json()[
        "items"
    ]
    assert client.get("/v1/deliveries", params={"state": "waiting"}).json()["items"] == []
    shown = client.get(f"/v1/deliveries/{held.delivery_id}").json()
    assert {name: shown[name] for name in listed} == listed
    error = {"code": "unreachable", "detail": "The target does not answer."}
    assert (shown["state"], shown["attempts"], shown["error"], shown["next_attempt"]) == ("failed", 1, error, None)
    assert [(item["name"], item["state"]) for item in shown["objects"]] == [
        ("report.dcm", "delivered"), ("chamber.dcm", "waiting"),
    ]  # fmt: skip
    assert [(attempt["number"], attempt["error"]) for attempt in shown["history"]] == [(1, error)]


def test_retry(client: TestClient, held: Claim) -> None:
    give_up(held)
    answer = client.post(f"/v1/deliveries/{held.delivery_id}:retry")
    assert (answer.status_code, answer.json()["state"]) == (202, "waiting")
    with writing() as session:
        again = outbox.claim(session, "pacs", "tester")
        assert again is not None
        assert outbox.set_objects(session, again, {"1.2.3": "a", "1.2.4": "b"}) == {
            "1.2.3": ObjectState.DELIVERED, "1.2.4": ObjectState.WAITING,
        }  # fmt: skip
        outbox.finish(session, again)
    answer = client.post(f"/v1/deliveries/{held.delivery_id}:retry")
    assert (answer.status_code, answer.json()["code"]) == (409, "delivered")


def test_request(client: TestClient, held: Claim) -> None:
    path = f"/v1/jobs/{held.job_id}/deliveries"
    assert client.post(path, json={"target": "none"}).json()["code"] == "unknown_target"
    assert client.post("/v1/jobs/none/deliveries", json={"target": "pacs"}).status_code == 404
    with writing() as session:
        outbox.register(session, "archive")
    answer = client.post(path, json={"target": "archive"})
    assert answer.status_code == 202
    assert client.get(answer.headers["location"]).json()["state"] == "waiting"


def test_running_job_is_not_sent(client: TestClient, study: FinishedStudy) -> None:
    with writing() as session:
        outbox.register(session, "pacs")
    answer = client.post(f"/v1/jobs/{study.job_id}/deliveries", json={"target": "pacs"})
    assert (answer.status_code, answer.json()["code"]) == (409, "not_ready")


def test_metrics(client: TestClient, held: Claim) -> None:
    def values() -> dict[str, float]:
        lines = re.findall(r"^fluoromap_(\w*deliver\w*)\{(.+)\} (\S+)$", client.get("/metrics").text, re.M)
        return {f"{name} {labels}": float(value) for name, labels, value in lines}

    before = values()
    assert before['deliveries target="pacs",state="sending"'] == 1
    assert before['delivered_objects_total target="pacs"'] == 1
    assert before['oldest_delivery_seconds target="pacs"'] > 0
    give_up(held)
    after = values()
    assert after['deliveries target="pacs",state="sending"'] == after['oldest_delivery_seconds target="pacs"'] == 0
    assert after['deliveries_total target="pacs",state="failed"'] == after['delivery_failures_total target="pacs"'] == 1
