"""A disk that is nearly full: uploads are refused before the end, and readiness says so."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from finished_study import make_study
from sqlalchemy import select
from sqlalchemy.exc import OperationalError

from fluoromap_service.api.http.spooled_answers import spooled_answer
from fluoromap_service.api.service import health
from fluoromap_service.settings import settings
from fluoromap_service.store import disk, files
from fluoromap_service.store.disk import NoSpace
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Instance


def _files_check(service: TestClient) -> dict[str, Any]:
    checks = service.get("/v1/ready").json()["checks"]
    return next(check for check in checks if check["name"] == "files")


def test_writing_stops_at_the_reserve(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "ANSWER_SECONDS", 0.0)
    study = make_study()
    assert _files_check(service)["ok"]
    monkeypatch.setattr(disk, "free_bytes", lambda: disk.reserve_bytes() - 1)
    answer = service.post("/v1/studies", json={"label": "x"})
    assert (answer.status_code, answer.json()["code"]) == (507, "no_space")
    ready = service.get("/v1/ready")
    assert ready.status_code == 503
    assert "nearly full" in _files_check(service)["detail"]
    assert service.get("/v1/studies").status_code == 200
    assert service.post(f"/v1/jobs/{study.job_id}:cancel").status_code == 202
    assert service.delete(f"/v1/studies/{study.study_id}").status_code == 204


READS_THAT_WRITE = ("mesh.ply", "map.png", "dicom", "archive.zip", "report.html", "deidentified.zip")


def test_reads_that_write_stop_at_the_reserve(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    study = make_study()
    study.finish()
    kept = f"/v1/jobs/{study.job_id}/mesh.stl"
    content = service.get(kept).content
    before = sorted(path.name for path in settings().files_dir.glob("*/*"))
    monkeypatch.setattr(disk, "free_bytes", lambda: disk.reserve_bytes() - 1)
    for name in READS_THAT_WRITE:
        answer = service.get(f"/v1/jobs/{study.job_id}/{name}")
        assert (name, answer.status_code, answer.json()["code"]) == (name, 507, "no_space")
    assert service.get(kept).content == content
    assert sorted(path.name for path in settings().files_dir.glob("*/*")) == before


def test_an_export_needs_room_for_all_that_it_writes(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    study = make_study()
    study.finish()
    with reading() as session:
        runs = [files.path_of(sha256).stat().st_size for sha256 in session.scalars(select(Instance.sha256))]
    address = f"/v1/jobs/{study.job_id}/deidentified.zip"
    monkeypatch.setattr(disk, "free_bytes", lambda: disk.reserve_bytes() + 2 * sum(runs) - 1)
    assert service.get(address).status_code == 507
    assert list(files.incoming_folder().iterdir()) == []


def test_a_long_table_stops_at_the_reserve(data_dir: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk, "free_bytes", lambda: disk.reserve_bytes())
    assert spooled_answer([b"short"], "text/csv", {}).status_code == 200
    with pytest.raises(NoSpace):
        spooled_answer((bytes(2**18) for _ in range(8)), "text/csv", {})


def test_a_body_that_would_fill_the_reserve_is_refused(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk, "free_bytes", lambda: disk.reserve_bytes() + 1000)
    assert service.post("/v1/studies", json={"label": "x"}).status_code == 201
    assert service.post("/v1/studies", json={"label": "x", "notes": "y" * 1000}).status_code == 507


def test_an_upload_without_a_length_stops_at_the_reserve(
    service: TestClient, study_path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk, "free_bytes", lambda: disk.reserve_bytes() + 2**20)
    parts = (b"x" * 2**19 for _ in range(8))
    answer = service.post(f"{study_path}/instances", content=parts, headers={"Content-Type": "application/dicom"})
    assert (answer.status_code, answer.json()["code"]) == (507, "no_space")
    assert list(files.incoming_folder().iterdir()) == []


def test_a_full_disk_is_507(service: TestClient, upload: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files, "keep", full)
    assert upload((1, 0.0)).status_code == 507
    monkeypatch.undo()
    assert upload((1, 0.0)).status_code == 201


def test_a_full_database_is_no_space(data_dir: object) -> None:
    with pytest.raises(NoSpace), writing():
        raise OperationalError("INSERT", None, Exception("database or disk is full"))
