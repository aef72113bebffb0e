"""The audit trail of requests: reads of patient data included, without patient data itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from finished_study import make_study
from small_runs import run_uid

from fluoromap_service import auth
from fluoromap_service.store import audit
from fluoromap_service.store.engine import reading, writing


def _entries(service: TestClient) -> list[dict[str, Any]]:
    app = service.app
    assert isinstance(app, FastAPI)
    app.state.acts.flush()
    with reading() as session:
        assert audit.verify(session)[0] == len(list(audit.entries(session)))
        return [audit.as_json(entry) for entry in audit.entries(session)]


def test_acts_are_recorded_with_caller_and_study(
    service: TestClient, study_path: str, upload: Callable[..., Any]
) -> None:
    study_id = study_path.rpartition("/")[2]
    upload((1, 0.0))
    service.get(f"{study_path}/instances/{run_uid(1)}/frames/1.png")
    service.delete(study_path)
    service.get("/v1/plugins")
    service.get("/v1/health")
    entries = _entries(service)
    assert {entry["who"] for entry in entries} == {"open"}
    assert [(entry["what"], entry["study"], entry["status"]) for entry in entries] == [
        ("POST /v1/studies", study_id, 201),
        ("POST /v1/studies/{study_id}/instances", study_id, 201),
        ("GET /v1/studies/{study_id}/instances/{uid}/frames/{n}.png", study_id, 200),
        ("DELETE /v1/studies/{study_id}", study_id, 204),
    ]


def test_a_read_of_a_job_names_its_study_and_its_reader(service: TestClient) -> None:
    study = make_study()
    token = auth.create_token("Dr. Ada", ["read"])
    service.get(f"/v1/jobs/{study.job_id}/points", headers={"Authorization": f"Bearer {token}"})
    service.get("/v1/studies/Doe%5EJane", headers={"Authorization": f"Bearer {token}"})
    service.get("/v1/studies")
    made, read, lost = _entries(service)
    assert (made["who"], made["what"]) == ("command line", "token create Dr. Ada")
    assert (read["who"], read["job"], read["study"]) == ("Dr. Ada", study.job_id, study.study_id)
    assert (lost["study"], lost["status"]) == (None, 404)


def test_equal_reads_of_one_moment_are_one_entry(service: TestClient) -> None:
    for _ in range(3):
        service.get("/v1/studies")
        service.post("/v1/studies", json={"label": "x"})
    whats = [entry["what"] for entry in _entries(service)]
    assert (whats.count("GET /v1/studies"), whats.count("POST /v1/studies")) == (1, 3)


def test_acts_wait_for_a_database_that_is_away(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    service.get("/v1/studies")
    app = service.app
    assert isinstance(app, FastAPI)

    def away(*_: Any) -> None:
        raise ConnectionError

    with monkeypatch.context() as patched:
        patched.setattr(audit, "append", away)
        with pytest.raises(ConnectionError), writing():
            app.state.acts.flush()
    assert len(_entries(service)) == 1
