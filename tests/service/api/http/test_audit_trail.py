"""The audit trail of requests: reads of patient data included, without patient data itself."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from finished_study import make_study
from small_runs import STUDY_UID, run_uid, small_run
from starlette.routing import Route

from fluoromap_service import auth
from fluoromap_service.api.http.middleware.audit_trail import MOST_REFUSALS, OTHERS, REFUSAL_SECONDS, Acts
from fluoromap_service.store import audit
from fluoromap_service.store.audit import Act
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
    deleted, *entries = _entries(service)
    assert (deleted["what"][:12], deleted["study"]) == ("delete study", study_id)
    assert {entry["who"] for entry in (deleted, *entries)} == {"open"}
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


def test_equal_reads_of_one_moment_are_one_entry_with_their_number(service: TestClient) -> None:
    for _ in range(3):
        service.get("/v1/studies")
        service.post("/v1/studies", json={"label": "x"})
    entries = _entries(service)
    assert [entry.get("times") for entry in entries if entry["what"].startswith("GET")] == [3]
    assert [entry.get("times") for entry in entries if entry["what"].startswith("POST")] == [None] * 3


def _stored(service: TestClient, number: int, folder: Path) -> str:
    """Store a run in a new mapping study; return the study's id."""
    study = service.post("/v1/studies", json={"label": "x"}).headers["location"]
    content = small_run(folder, number, 0.0)
    service.post(
        f"{study}/instances", content=content, headers={"Content-Type": "application/dicom"}
    ).raise_for_status()
    return str(study.rpartition("/")[2])


def test_every_route_of_dicomweb_that_names_a_study_is_recorded_with_it(service: TestClient, tmp_path: Path) -> None:
    """Each mapping study that holds runs of the DICOM study has an entry, and none holds its UID."""
    studies = sorted(_stored(service, number, tmp_path) for number in (1, 1, 2))
    app = service.app
    assert isinstance(app, FastAPI)
    routes = [route for route in app.routes if isinstance(route, Route) and route.path.startswith("/dicom-web/")]
    named = [route for route in routes if "{study_uid}" in route.path and "GET" in (route.methods or ())]
    assert len(named) >= 10
    before = len(_entries(service))
    for route in named:
        address = route.path.replace("{study_uid}", STUDY_UID).replace("{number}", "1").replace("{numbers}", "1")
        service.get(re.sub(r"\{[^}]*\}", run_uid(1), address))
    entries = _entries(service)[before:]
    assert {entry["what"] for entry in entries} == {f"GET {route.path}" for route in named}
    for what in {entry["what"] for entry in entries}:
        assert sorted(entry["study"] for entry in entries if entry["what"] == what) == studies, what
    assert STUDY_UID not in json.dumps(entries)
    assert all("{study_uid}" in route.path for route in routes if "{" in route.path)


def test_reads_of_two_studies_are_never_one_entry(service: TestClient) -> None:
    paths = [service.post("/v1/studies", json={"label": "x"}).headers["location"] for _ in range(2)]
    for _ in range(2):
        for path in paths:
            service.get(path)
    reads = [entry for entry in _entries(service) if entry["what"].startswith("GET")]
    assert [(entry["study"], entry["times"]) for entry in reads] == [(path.rpartition("/")[2], 2) for path in paths]


def _end(service: TestClient) -> list[dict[str, Any]]:
    app = service.app
    assert isinstance(app, FastAPI)
    app.state.acts.flush(ending=True)
    return _entries(service)


def test_refusals_are_recorded_with_caller_or_address(service: TestClient) -> None:
    study = make_study()
    token = auth.create_token("reader", ["read"])
    for _ in range(3):
        assert service.get(f"/v1/studies/{study.study_id}").status_code == 401
    refused = service.delete(f"/v1/studies/{study.study_id}", headers={"Authorization": f"Bearer {token}"})
    assert refused.status_code == 403
    assert [entry["what"] for entry in _entries(service)] == ["token create reader"]
    _, unknown, known = _end(service)
    route = "/v1/studies/{study_id}"
    assert (unknown["who"], unknown["what"], unknown["study"]) == ("address testclient", f"GET {route}", study.study_id)
    assert (unknown["status"], unknown["times"]) == (401, 3)
    assert (known["who"], known["what"], known["study"]) == ("reader", f"DELETE {route}", study.study_id)
    assert known["status"] == 403


@pytest.mark.parametrize("status", [401, 403, 429])
def test_a_flood_of_refusals_is_a_bounded_number_of_entries(data_dir: object, status: int) -> None:
    now = [0.0]
    acts = Acts(lambda: now[0])
    for minute in range(2):
        for number in range(3 * MOST_REFUSALS):
            acts.refuse(Act(f"address 10.0.{minute}.{number}", "GET /v1/studies", status=status))
        acts.flush()
        now[0] += REFUSAL_SECONDS
        acts.flush()
    with reading() as session:
        entries = [audit.as_json(entry) for entry in audit.entries(session)]
    assert len(entries) == 2 * (MOST_REFUSALS + 1)
    assert sum(entry.get("times", 1) for entry in entries) == 2 * 3 * MOST_REFUSALS
    assert [entry["times"] for entry in entries if entry["who"] == OTHERS] == [2 * MOST_REFUSALS] * 2


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
