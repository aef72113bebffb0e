"""Deleted studies: nothing of them stays, whenever the process ends, and a certificate says what went."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from small_runs import STUDY_UID, run_uid, small_run
from sqlalchemy import select
from typer.testing import CliRunner

from fluoromap_service.api.app import create_app
from fluoromap_service.cli.commands.audit import app as command
from fluoromap_service.settings import settings
from fluoromap_service.store import audit, files, reidentification, schema
from fluoromap_service.store.engine import forget_engine, reading, writing
from fluoromap_service.store.models import AuditEntry
from fluoromap_service.study import deletion
from fluoromap_service.study.orphans import SETTLED_SECONDS, orphans, remove_orphans


@pytest.fixture(params=["sqlite", "postgresql"])
def both(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """A client of a service on either database."""
    url = request.getfixturevalue("postgres_url") if request.param == "postgresql" else ""
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", url)
    settings.cache_clear()
    schema.upgrade()
    yield TestClient(create_app(), base_url="http://127.0.0.1")
    forget_engine()
    settings.cache_clear()


def _study(client: TestClient, folder: Path, *numbers: int) -> str:
    """Make a study with runs and an export; return its id."""
    path = client.post("/v1/studies", json={"label": "Label-7Q4Z"}).headers["location"]
    for number in numbers:
        content = small_run(folder, number, 0.0)
        client.post(f"{path}/instances", content=content, headers={"Content-Type": "application/dicom"})
    study_id = str(path.rpartition("/")[2])
    reidentification.add_replacements(study_id, {"1.2.3": "2.25.1"})
    return study_id


def _stored() -> set[str]:
    return {path.name for path in settings().files_dir.glob("??/*")}


def test_the_certificate_says_what_went(both: TestClient, tmp_path: Path) -> None:
    first, second = _study(both, tmp_path, 1, 2), _study(both, tmp_path, 1)
    before = _stored()
    assert both.get(f"/v1/deletions/{first}").status_code == 404
    assert both.delete(f"/v1/studies/{first}").status_code == 204
    answer = both.get(f"/v1/deletions/{first}")
    certificate = answer.json()
    assert (certificate["study"], certificate["by"], certificate["jobs"]) == (first, "open", [])
    assert (certificate["runs_deleted"], certificate["runs_of_other_studies"]) == (1, 1)
    assert set(certificate["files"]) == before - _stored()
    assert len(certificate["files"]) == 1
    assert (certificate["reidentification_table"], certificate["files_left"]) == (True, [])
    assert reidentification.studies_with_table() == {second}
    for secret in ("7Q4Z", STUDY_UID, run_uid(1), run_uid(2)):
        assert secret not in answer.text
    told = CliRunner().invoke(command, ["certificate", first])
    assert json.loads(told.output)["files"] == certificate["files"]
    assert CliRunner().invoke(command, ["certificate", second]).exit_code != 0


def test_the_audit_trail_holds_the_hash_of_the_certificate(both: TestClient, tmp_path: Path) -> None:
    study = _study(both, tmp_path, 1)
    both.delete(f"/v1/studies/{study}")
    certificate = both.get(f"/v1/deletions/{study}").json()
    with reading() as session:
        entry = session.scalars(select(AuditEntry).where(AuditEntry.id == certificate["audit"]["entry"])).one()
        assert audit.verify(session, [certificate["audit"]["hash"]])[0] >= 1
    assert (entry.hash, entry.study) == (certificate["audit"]["hash"], study)
    assert entry.what == f"delete study; certificate {certificate['certificate_sha256']}"
    own = ("deleted", "by", "files_left", "certificate_sha256", "audit")
    content = {name: value for name, value in certificate.items() if name not in own}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    assert hashlib.sha256(text.encode()).hexdigest() == certificate["certificate_sha256"]


def test_files_go_when_the_process_ended_after_the_commit(
    both: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, other = _study(both, tmp_path, 1), _study(both, tmp_path, 2)
    with monkeypatch.context() as ended:
        ended.setattr(deletion, "remove_files", lambda study_id, hashes: None)
        assert both.delete(f"/v1/studies/{study}").status_code == 204
    left = both.get(f"/v1/deletions/{study}").json()["files_left"]
    assert len(left) == 1
    assert list(orphans()) == []
    assert list(orphans(0)) == left
    assert remove_orphans(0) == 2
    assert both.get(f"/v1/deletions/{study}").json()["files_left"] == []
    assert (len(_stored()), reidentification.studies_with_table()) == (1, {other})
    assert remove_orphans(0) == 0
    assert SETTLED_SECONDS < 3600


def test_a_file_of_an_open_transaction_is_no_orphan(data_dir: Path) -> None:
    with writing() as session:
        sha256 = files.keep_bytes(session, b"arriving")
        assert list(orphans()) == []
    os.utime(files.path_of(sha256), (0, 0))
    assert remove_orphans(0) == 0
    assert files.path_of(sha256).exists()
