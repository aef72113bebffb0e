"""Plugins, health, readiness, and the OpenAPI document of the results."""

from __future__ import annotations

import functools
import itertools
import threading
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from finished_study import FinishedStudy

from fluoromap import registry
from fluoromap_service.api.service import health
from fluoromap_service.api.service.health import ReadinessWatch
from fluoromap_service.jobs import living_workers, queue
from fluoromap_service.jobs.stall import StallWatch
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import writing
from fluoromap_service.store.models import WorkerSeen


def test_plugins_are_listed_with_their_parameters(client: TestClient) -> None:
    listed = client.get("/v1/plugins").json()
    assert [(row["kind"], row["name"]) for row in listed] == [(row.kind, row.name) for row in registry.plugins()]
    fuser = next(row for row in listed if row["name"] == "smooth-surface")
    assert set(fuser) == {"kind", "name", "version", "distribution", "default", "parameters", "error"}
    assert fuser["default"] is True
    assert "fill_mm" in fuser["parameters"]["properties"]


def test_a_broken_plugin_is_a_row(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = registry.Plugin("fuser", "broken", None, "someone", None, "ImportError: no module")
    monkeypatch.setattr(registry, "plugins", lambda: (broken,))
    (row,) = client.get("/v1/plugins").json()
    assert (row["error"], row["parameters"], row["version"]) == ("ImportError: no module", None, None)


def test_alive(client: TestClient) -> None:
    assert client.get("/v1/health").json() == {"status": "alive"}


def test_ready_with_jobs_running_inside_the_service(client: TestClient) -> None:
    answer = client.get("/v1/ready")
    assert answer.status_code == 200
    assert [(check["name"], check["ok"]) for check in answer.json()["checks"]] == [
        ("database", True), ("broker", True), ("files", True), ("worker", True), ("queue", True),
    ]  # fmt: skip


@pytest.fixture(autouse=True)
def at_once(application: FastAPI, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each question is answered anew; no check is late, however busy the machine."""
    application.state.readiness = ReadinessWatch()
    monkeypatch.setattr(health, "ANSWER_SECONDS", 0.0)
    monkeypatch.setattr(health, "CHECK_SECONDS", 60.0)


def _checks(client: TestClient) -> tuple[int, dict[str, bool]]:
    answer = client.get("/v1/ready")
    return answer.status_code, {check["name"]: check["ok"] for check in answer.json()["checks"]}


def test_not_ready_without_a_worker(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLUOROMAP_BROKER_URL", "")
    # The process keeps its Celery application: this test gets another one, so that later tests keep theirs.
    monkeypatch.setattr(queue, "celery_app", functools.cache(queue.celery_app.__wrapped__))
    settings.cache_clear()
    assert _checks(client) == (503, {"database": True, "broker": True, "files": True, "worker": False, "queue": True})
    with writing() as session:
        living_workers.worker_seen(session, "worker")
    assert _checks(client)[0] == 200
    with writing() as session:
        session.get_one(WorkerSeen, "worker").seen -= 60
    assert _checks(client)[0] == 503


def test_not_ready_while_nobody_runs_the_ready_stages(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLUOROMAP_BROKER_URL", "")
    monkeypatch.setattr(queue, "celery_app", functools.cache(queue.celery_app.__wrapped__))
    settings.cache_clear()
    clock = itertools.count(0.0, 15.0)
    monkeypatch.setattr(health, "_stall", StallWatch(clock.__next__))
    with writing() as session:
        living_workers.worker_seen(session, "worker")
    assert [_checks(client)[0] for _ in range(3)] == [200, 200, 503]


def test_not_ready_without_files(client: TestClient, data_dir: Path) -> None:
    (data_dir / "files").write_text("in the way")
    status, checks = _checks(client)
    assert (status, checks["files"], checks["database"]) == (503, False, True)


def test_not_ready_without_tables(client: TestClient, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", f"sqlite:///{tmp_path / 'empty.sqlite'}")
    settings.cache_clear()
    status, checks = _checks(client)
    assert (status, checks["database"]) == (503, False)


def test_all_callers_share_one_answer(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "ANSWER_SECONDS", 3600.0)
    looks: list[str] = []
    monkeypatch.setitem(health._CHECKS, "files", (lambda: looks.append("look") or "", ""))
    assert {client.get("/v1/ready").status_code for _ in range(20)} == {200}
    assert looks == ["look"]


def test_nobody_waits_for_a_silent_broker(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """A broker that accepts connections and says nothing: one thread waits for it, and no caller."""
    monkeypatch.setattr(health, "CHECK_SECONDS", 0.05)
    speaks, asked = threading.Event(), []

    def silent() -> str:
        asked.append("ask")
        speaks.wait(60)
        return ""

    monkeypatch.setattr(health, "_CHECKS", {"broker": (silent, "The message broker does not answer; check its URL.")})
    assert [client.get("/v1/ready").status_code for _ in range(3)] == [503, 503, 503]
    assert asked == ["ask"]
    assert client.get("/v1/health").status_code == 200
    monkeypatch.setattr(health, "CHECK_SECONDS", 60.0)
    speaks.set()
    assert client.get("/v1/ready").status_code == 200


def test_every_route_is_documented(client: TestClient, study: FinishedStudy) -> None:
    paths = client.get("/v1/openapi.json").json()["paths"]
    assert "/v1/jobs/{job_id}/mesh.{mesh_format}" in paths
    ours = {path: methods for path, methods in paths.items() if "/jobs" in path or path.count("/") == 2}
    for path, methods in ours.items():
        for method, route in methods.items():
            assert route.get("summary"), f"{method} {path}"
            assert route.get("description"), f"{method} {path}"
            for parameter in route.get("parameters", []):
                assert parameter.get("description"), f"{method} {path} {parameter['name']}"
            if "{job_id}" in path:
                assert "404" in route["responses"], f"{method} {path}"
