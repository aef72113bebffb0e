"""Clean-up, retention and the check of the store: deleted means gone, and faults are found and mended."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi.testclient import TestClient
from finished_study import make_study
from small_runs import run_uid
from sqlalchemy import select, update

from fluoromap_service.settings import settings
from fluoromap_service.store import audit, disk, files
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import File, Idempotency, Instance, Job, Rendering, StageResult, StageRow, Study
from fluoromap_service.study import deletion, upkeep
from fluoromap_service.study.check import examine, mend
from fluoromap_service.study.upkeep import clean_up, delete_old_studies, delete_renderings


def _everything_written(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file())


def test_a_deleted_study_leaves_neither_label_nor_notes(service: TestClient, data_dir: Path) -> None:
    label, notes = "Label-7Q4Z", "Notes-9X2K " * 500
    keys = iter(range(10))
    made = service.post(
        "/v1/studies", json={"label": label, "notes": notes}, headers={"Idempotency-Key": f"k{next(keys)}"}
    )
    path = made.headers["location"]
    for change in ({"label": f"{label}-second"}, {"notes": f"{notes} again"}):
        assert service.patch(path, json=change).status_code == 200
    assert b"7Q4Z" in _everything_written(data_dir)
    with reading() as session:
        assert label in (session.scalars(select(Idempotency.body)).one() or "")
    assert service.delete(path).status_code == 204
    rest = _everything_written(data_dir)
    assert b"7Q4Z" not in rest
    assert b"9X2K" not in rest


def test_only_the_user_of_the_service_can_read_the_data(
    service: TestClient, upload: Callable[..., Any], data_dir: Path
) -> None:
    assert upload((1, 0.0)).status_code == 201
    assert data_dir.stat().st_mode & 0o777 == 0o700
    for path in data_dir.glob("fluoromap.sqlite*"):
        assert path.stat().st_mode & 0o777 == 0o600, path.name
    assert all(path.stat().st_mode & 0o077 == 0 for path in (data_dir / "files").rglob("*") if path.is_file())


def test_an_existing_open_folder_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "old"
    folder.mkdir(mode=0o755)
    (folder / "fluoromap.sqlite").touch(0o644)
    environment = {**os.environ, "FLUOROMAP_DATA_DIR": str(folder)}
    program = "from fluoromap_service.store.schema import upgrade; upgrade()"
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert (folder / "fluoromap.sqlite").stat().st_mode & 0o777 == 0o600


def test_uploads_that_broke_off_are_removed_and_running_ones_stay(data_dir: Path) -> None:
    with files.incoming() as running:
        dead = running.with_name("dead")
        dead.write_bytes(b"x")
        old = time.time() - 60
        os.utime(dead, (old, old))
        os.utime(running, (old, old))
        clean_up()
        assert running.exists()
        assert not dead.exists()


def test_answers_are_forgotten_after_a_day(service: TestClient) -> None:
    service.post("/v1/studies", json={"label": "x"}, headers={"Idempotency-Key": "k"})
    clean_up()
    with writing() as session:
        assert session.scalars(select(Idempotency.id)).all() != []
        session.execute(update(Idempotency).values(created=db_now() - 25 * 3600))
    clean_up()
    with reading() as session:
        assert session.scalars(select(Idempotency.id)).all() == []


def test_old_studies_are_deleted_when_their_jobs_have_ended(service: TestClient) -> None:
    running = make_study()
    service.post("/v1/studies", json={"label": "old"})
    service.post("/v1/studies", json={"label": "new"})
    with writing() as session:
        month = 31 * 86400
        session.execute(update(Study).where(Study.label != "new").values(updated=db_now() - month))
        session.execute(update(Job).values(created=db_now() - month))
    assert delete_old_studies(30) == 1
    with reading() as session:
        assert set(session.scalars(select(Study.label))) == {"rhythm", "new"}
        assert [(entry.who, entry.what[:12]) for entry in audit.entries(session)] == [("retention", "delete study")]
    running.finish()
    assert delete_old_studies(30) == 1
    with reading() as session:
        # No study of this test refers to its runs, so nothing deletes them.
        runs = set(session.scalars(select(Instance.sha256)))
    assert {path.name for path in settings().files_dir.glob("??/*")} == runs


def test_a_recent_job_keeps_an_old_study(service: TestClient) -> None:
    study = make_study()
    study.finish()
    with writing() as session:
        session.execute(update(Study).values(updated=db_now() - 31 * 86400))
    assert delete_old_studies(30) == 0


@pytest.mark.parametrize("change", ["upload", "activation-times"])
def test_a_change_of_its_content_keeps_an_old_study(
    service: TestClient, study_path: str, upload: Callable[..., Any], change: str
) -> None:
    _make_older(31)
    if change == "upload":
        assert upload((1, 0.0)).status_code == 201
    else:
        table = service.put(
            f"{study_path}/activation-times", content=b"site,lat_ms\nS01,1.0\n", headers={"Content-Type": "text/csv"}
        )
        assert table.status_code == 200
    assert delete_old_studies(30) == 0


def test_a_study_that_changes_during_the_deletion_stays(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    for label in ("first", "second"):
        service.post("/v1/studies", json={"label": label})
    _make_older(31)

    def change_the_rest(study_id: str, hashes: object) -> None:
        with writing() as session:
            session.execute(update(Study).values(updated=db_now()))

    monkeypatch.setattr(deletion, "remove_files", change_the_rest)
    assert delete_old_studies(30) == 1


def _make_older(days: float) -> None:
    with writing() as session:
        session.execute(update(Study).values(updated=db_now() - days * 86400))


def test_a_low_disk_costs_pictures_only(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    study = make_study()
    study.finish()
    mesh = f"/v1/jobs/{study.job_id}/mesh.ply"
    content = service.get(mesh).content
    clean_up()
    with reading() as session:
        (kept,) = session.scalars(select(Rendering.sha256)).all()
    monkeypatch.setattr(disk, "free_bytes", lambda: disk.reserve_bytes() + 1)
    clean_up()
    assert not files.path_of(kept).exists()
    with reading() as session:
        assert session.scalars(select(Rendering.id)).all() == []
    assert delete_renderings() == 0
    assert service.get(mesh).content == content


def test_kept_renderings_have_a_space_and_the_longest_unused_go(
    service: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = make_study()
    study.finish()
    addresses = [f"/v1/jobs/{study.job_id}/mesh.{kind}" for kind in ("ply", "stl", "glb")]
    for address in addresses:
        service.get(address).raise_for_status()
    with writing() as session:
        rows = session.scalars(select(Rendering).order_by(Rendering.id)).all()
        sizes = [row.bytes for row in rows]
        keys = [row.key for row in rows]
        for age, row in enumerate(rows):
            row.used = 1000.0 * age
        rows[1].bytes = None  # as an earlier version leaves it
    assert sizes == [files.path_of(row.sha256).stat().st_size for row in rows]
    # The first is used again, so the second is now the longest unused.
    service.get(addresses[0]).raise_for_status()
    monkeypatch.setattr(
        upkeep, "settings", lambda: SimpleNamespace(retention_days=0, renderings_mib=(sum(sizes) - 1) / 2**20)
    )
    clean_up()
    with reading() as session:
        assert list(session.scalars(select(Rendering.key).order_by(Rendering.id))) == [keys[0], keys[2]]
    assert not files.path_of(rows[1].sha256).exists()
    clean_up()
    with reading() as session:
        assert len(session.scalars(select(Rendering.id)).all()) == 2


def test_the_check_finds_nothing_in_a_sound_store(service: TestClient) -> None:
    study = make_study()
    study.finish()
    service.get(f"/v1/jobs/{study.job_id}/mesh.ply")
    found = examine(settled_seconds=0)
    assert found == type(found)(0, (), (), (), (), ())


def test_the_check_finds_and_mends_orphans(data_dir: Path) -> None:
    with files.incoming() as path, writing() as session:
        path.write_bytes(b"orphan")
        orphan = files.keep(session, path)
        session.rollback()
    with writing() as session:
        unused = files.keep_bytes(session, b"unused")
    assert examine().orphans == ()
    found = examine(settled_seconds=0)
    assert (found.orphans, found.unused) == ((orphan,), (unused,))
    mend(found)
    again = examine(settled_seconds=0)
    assert (again.orphans, again.unused) == ((), ())
    assert not files.path_of(orphan).exists()
    assert not files.path_of(unused).exists()


def test_the_check_names_damaged_content(service: TestClient, study_path: str, upload: Callable[..., Any]) -> None:
    upload((1, 0.0))
    study = make_study()
    study.finish()
    with writing() as session:
        run = session.scalars(select(Instance.sha256).where(Instance.sop_instance_uid == run_uid(1))).one()
        result = session.scalars(select(StageRow.result).where(StageRow.name == "fuse")).one()
        session.add(StageResult(key="k", sha256=result))
    assert result is not None
    files.path_of(run).unlink()
    files.path_of(result).write_bytes(b"")
    found = examine()
    assert (found.broken_runs, found.broken_results, found.jobs) == ((run_uid(1),), (result,), (study.job_id,))
    mend(found)
    with reading() as session:
        assert session.get(StageResult, "k") is None
        assert session.get(File, run) is not None
    upload((1, 0.0))
    assert examine().broken_runs == ()
