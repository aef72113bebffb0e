"""Backup and restore: on SQLite by command, on PostgreSQL by the documented procedure."""

from __future__ import annotations

import functools
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import servers
from fastapi.testclient import TestClient
from sqlalchemy import make_url, select

from fluoromap_service.api.app import create_app
from fluoromap_service.settings import settings
from fluoromap_service.store import files, schema
from fluoromap_service.store.backup import BackupFailed, backup, restore
from fluoromap_service.store.engine import forget_engine, reading, writing
from fluoromap_service.store.models import File, Study
from fluoromap_service.study import studies
from fluoromap_service.study.check import examine
from fluoromap_service.study.upkeep import clean_up

PAGE = Path(__file__).parents[3] / "docs" / "operations.md"


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Switch to the service with this data folder and database."""

    def switch(name: str, url: str = "") -> Path:
        monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(tmp_path / name))
        monkeypatch.setenv("FLUOROMAP_DATABASE_URL", url)
        settings.cache_clear()
        return tmp_path / name

    yield switch
    forget_engine()
    settings.cache_clear()


def _fill(upload_to: Callable[[TestClient, str], Any]) -> dict[str, Any]:
    schema.upgrade()
    client = TestClient(create_app(), base_url="http://127.0.0.1")
    path = client.post("/v1/studies", json={"label": "kept", "notes": "for long"}).headers["location"]
    upload_to(client, path)
    return _content()


def _content() -> dict[str, Any]:
    client = TestClient(create_app(), base_url="http://127.0.0.1")
    (study,) = client.get("/v1/studies").json()["items"]
    runs = client.get(f"/v1/studies/{study['id']}/instances").json()["items"]
    pictures = [
        client.get(f"/v1/studies/{study['id']}/instances/{run['sop_instance_uid']}/frames/1.png").content
        for run in runs
    ]
    with reading() as session:
        stored = sorted(session.scalars(select(File.sha256)))
    return {"study": study, "runs": runs, "pictures": pictures, "whole": [files.is_whole(sha256) for sha256 in stored]}


@pytest.fixture
def upload_to(tmp_path: Path) -> Callable[[TestClient, str], Any]:
    from small_runs import small_run

    def send(client: TestClient, path: str) -> None:
        parts = [("file", (f"{n}.dcm", small_run(tmp_path, n, 90.0 * n), "application/dicom")) for n in (0, 1)]
        assert client.post(f"{path}/instances", files=parts).status_code == 201

    return send


@pytest.fixture
def archive(use: Callable[..., Path], upload_to: Any, tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    """A backup of a study with two runs, and the answers of the service at that time."""
    use("live")
    content = _fill(upload_to)
    target = tmp_path / "backup.tar"
    assert backup(target).broken == ()
    return target, content


def test_a_backup_restores_everything(archive: Any, use: Callable[..., Path]) -> None:
    target, content = archive
    assert target.stat().st_mode & 0o077 == 0
    assert not list(files.incoming_folder().iterdir())
    use("restored")
    assert restore(target).files == 2
    assert _content() == content
    with pytest.raises(BackupFailed, match="exists"):
        restore(target)


def test_the_service_writes_while_the_database_is_copied(
    archive: Any, use: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, content = archive

    class Copied(sqlite3.Connection):
        def backup(self, target: sqlite3.Connection) -> None:  # type: ignore[override]
            with writing() as session:
                studies.create(session, "late")
            super().backup(target)

    monkeypatch.setattr(sqlite3, "connect", functools.partial(sqlite3.connect, factory=Copied))
    backup(tmp_path / "second.tar")
    with reading() as session:
        assert set(session.scalars(select(Study.label))) == {"kept", "late"}
    use("restored")
    restore(tmp_path / "second.tar")
    assert _content() == content


def test_a_killed_backup_leaves_no_patient_data_for_long(archive: Any, tmp_path: Path) -> None:
    """Hard links would keep the runs of a study that is deleted later."""
    folder = settings().data_dir
    before = set(folder.rglob("*"))
    program = (
        "import os, pathlib, signal, sys; from fluoromap_service.store import audit, backup; "
        "audit.append = lambda *_: os.kill(os.getpid(), signal.SIGKILL); backup.backup(pathlib.Path(sys.argv[1]))"
    )
    killed = subprocess.run([sys.executable, "-c", program, str(tmp_path / "second.tar")], check=False)
    assert killed.returncode == -signal.SIGKILL
    left = set(folder.rglob("*")) - before
    assert len([path for path in left if path.is_file() and re.fullmatch("[0-9a-f]{64}", path.name)]) == 2
    for path in left:
        os.utime(path, (0, 0))
    clean_up()
    assert set(folder.rglob("*")) - before == set()


def test_a_left_write_ahead_log_is_not_mixed_into_the_backup(archive: Any, use: Callable[..., Path]) -> None:
    target, _ = archive
    folder = use("restored")
    folder.mkdir()
    (folder / "fluoromap.sqlite-wal").write_bytes(b"rows of the lost database")
    with pytest.raises(BackupFailed, match="sqlite-wal exists"):
        restore(target)


def test_a_copy_of_the_database_file_alone_would_not_do(archive: Any) -> None:
    """The write-ahead log has the newest rows: the reason for the command."""
    assert (settings().data_dir / "fluoromap.sqlite-wal").exists()


def test_a_damaged_backup_is_refused(archive: Any, use: Callable[..., Path], tmp_path: Path) -> None:
    target, _ = archive
    with tarfile.open(target) as whole:
        place = next(member.offset_data for member in whole if member.name.startswith("files/"))
    content = bytearray(target.read_bytes())
    content[place + 200] ^= 1
    target.write_bytes(content)
    folder = use("restored")
    with pytest.raises(BackupFailed, match="other content"):
        restore(target)
    assert not (folder / "fluoromap.sqlite").exists()
    hostile = tmp_path / "hostile.tar"
    with tarfile.open(hostile, "w") as made:
        made.add(target, "files/../../escaped")
    with pytest.raises(BackupFailed, match="no backup"):
        restore(hostile)


def test_a_backup_names_what_is_broken(archive: Any, tmp_path: Path) -> None:
    with reading() as session:
        first, second = session.scalars(select(File.sha256)).all()
    files.path_of(first).unlink()
    files.path_of(second).write_bytes(b"damaged")
    made = backup(tmp_path / "second.tar")
    assert (made.files, made.broken) == (0, tuple(sorted((first, second))))


def test_the_procedure_for_postgresql_restores_everything(
    use: Callable[..., Path], fresh_postgres: Any, upload_to: Any, tmp_path: Path
) -> None:
    """Run the shell lines of docs/operations.md as they are written there."""
    programs = servers.postgresql_programs()
    block = dict(re.findall(r"```sh\n# (PostgreSQL: \w+)\n(.*?)```", PAGE.read_text(), re.S))
    with fresh_postgres() as first, fresh_postgres() as second:
        live = use("live", first)
        content = _fill(upload_to)
        with pytest.raises(BackupFailed, match="pg_dump"):
            backup(tmp_path / "backup.tar")
        _run(block["PostgreSQL: backup"], programs, first, live, tmp_path)
        forget_engine()
        restored = use("restored", second)
        restored.mkdir()
        _run(block["PostgreSQL: restore"], programs, second, restored, tmp_path)
        schema.upgrade()
        assert _content() == content
        assert examine().broken_runs == ()
        forget_engine()


def _run(lines: str, programs: Path, url: str, folder: Path, backups: Path) -> None:
    plain = make_url(url).set(drivername="postgresql").render_as_string(hide_password=False)
    environment = {
        "PATH": f"{programs}:/usr/bin:/bin",
        "DATABASE": plain,
        "FLUOROMAP_DATA_DIR": str(folder),
        "BACKUPS": str(backups),
    }
    subprocess.run([shutil.which("bash") or "bash", "-euc", lines], env=environment, check=True)
