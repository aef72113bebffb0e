"""The routes of deliveries and their metrics."""

from __future__ import annotations

import re

import pytest
from delivery_peers import TARGETS
from fastapi.testclient import TestClient
from finished_study import FinishedStudy

from fluoromap_service.deliveries import outbox
from fluoromap_service.deliveries.outbox import Claim, Failure
from fluoromap_service.store.engine import writing
from fluoromap_service.store.models import ObjectState

pytestmark = pytest.mark.usefixtures("file_processes")


@pytest.fixture
def held(study: FinishedStudy) -> Claim:
    """A claimed delivery of a finished job, one of whose two objects has arrived."""
    with writing() as session:
        outbox.register(session, TARGETS)
    study.finish()
    with writing() as session:
        outbox.plan(session, "pacs", ["succeeded"])
        claim = outbox.claim(session, "pacs", "tester")
        assert claim is not None
        outbox.begin_objects(session, claim, {"1.2.3": "report.dcm", "1.2.4": "chamber.dcm"})
        outbox.set_object_state(session, claim, "1.2.3", ObjectState.DELIVERED)
    return claim


def give_up(held: Claim) -> None:
    failure = Failure("unreachable", "The target does not answer.")
    with writing() as session:
        assert outbox.fail(session, held, failure, wait_seconds=None, give_up_days=7)


def path_of(held: Claim) -> str:
    return f"/v1/jobs/{held.job_id}/deliveries/{held.delivery_id}"


def test_state_objects_and_history(client: TestClient, held: Claim) -> None:
    def listed(**query: str) -> list[str]:
        return [item["id"] for item in client.get("/v1/deliveries", params=query).json()["items"]]

    assert listed(state="pending") == [held.delivery_id]
    give_up(held)
    assert listed(job=held.job_id, state="failed", target="pacs") == [held.delivery_id]
    assert listed(state="pending") == []
    shown = client.get(path_of(held)).json()
    error = {"code": "unreachable", "detail": "The target does not answer."}
    assert (shown["state"], shown["attempts"], shown["error"], shown["next_attempt"]) == ("failed", 1, error, None)
    columns = ("sop_instance_uid", "name", "state", "attempts", "error")
    assert [tuple(item[column] for column in columns) for item in shown["instances"]] == [
        ("1.2.3", "report.dcm", "delivered", 1, None),
        ("1.2.4", "chamber.dcm", "failed", 1, error),
    ]
    assert [(attempt["number"], attempt["error"]) for attempt in shown["history"]] == [(1, error)]


def test_delivery_of_another_job_is_not_found(client: TestClient, held: Claim) -> None:
    assert client.get(f"/v1/jobs/none/deliveries/{held.delivery_id}").status_code == 404
    assert client.post(f"/v1/jobs/none/deliveries/{held.delivery_id}:retry").status_code == 404


def test_retry(client: TestClient, held: Claim) -> None:
    give_up(held)
    answer = client.post(f"{path_of(held)}:retry")
    assert (answer.status_code, answer.json()["state"]) == (202, "pending")
    with writing() as session:
        again = outbox.claim(session, "pacs", "tester")
        assert again is not None
        assert outbox.begin_objects(session, again, {"1.2.3": "a", "1.2.4": "b"}) == {
            "1.2.3": ObjectState.DELIVERED, "1.2.4": ObjectState.PENDING,
        }  # fmt: skip
        outbox.finish(session, again)
    assert client.post(f"{path_of(held)}:retry").json()["state"] == "delivered"


def test_request_lists_the_objects_at_once(client: TestClient, held: Claim) -> None:
    path = f"/v1/jobs/{held.job_id}/deliveries"
    assert client.post(path, json={"target": "none"}).json()["code"] == "unknown_target"
    assert client.post("/v1/jobs/none/deliveries", json={"target": "pacs"}).status_code == 404
    answer = client.post(path, json={"target": "archive"}, headers={"Idempotency-Key": "k"})
    assert answer.status_code == 202
    assert client.get(answer.headers["location"]).json() == answer.json()
    assert (answer.json()["target"], answer.json()["state"]) == ("archive", "pending")
    assert {(item["name"], item["state"], item["attempts"], item["error"]) for item in answer.json()["instances"]} >= {
        ("report.dcm", "pending", 0, None), ("chamber.dcm", "pending", 0, None),
    }  # fmt: skip
    replayed = client.post(path, json={"target": "archive"}, headers={"Idempotency-Key": "k"})
    again = client.post(path, json={"target": "archive"})
    assert replayed.json()["id"] == again.json()["id"] == answer.json()["id"]
    assert client.post(path, json={"target": "hook"}).json()["instances"] == []


def test_running_job_is_not_sent(client: TestClient, study: FinishedStudy) -> None:
    with writing() as session:
        outbox.register(session, TARGETS)
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
