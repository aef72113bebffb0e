"""The commands on the store: backup, restore, check and the audit trail."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from program import Program, one_sentence


@pytest.fixture
def first_token(fluoromap: Program) -> str:
    """A store with one token, which is one entry of the audit trail."""
    return fluoromap("token", "create", "--name", "ada", "--scope", "write").stdout.strip()


def test_backup_and_restore(fluoromap: Program, first_token: str, tmp_path: Path) -> None:
    assert fluoromap("backup", "all.tar").stdout == "all.tar: the database and 0 files\n"
    assert "exists" in one_sentence(fluoromap("restore", "all.tar"))
    restored = str(tmp_path / "restored")
    assert fluoromap("restore", "all.tar", "--data-dir", restored).returncode == 0
    assert "ada" in fluoromap("token", "list", "--data-dir", restored).stdout
    (tmp_path / "wrong.tar").write_bytes(b"no archive" * 100)
    assert "damaged" in one_sentence(fluoromap("restore", "wrong.tar", "--data-dir", str(tmp_path / "other")))
    assert fluoromap("restore", "none.tar").returncode == 2


def test_check_of_a_sound_store(fluoromap: Program, first_token: str) -> None:
    for arguments in (["check", "--dry-run"], ["check"]):
        answer = fluoromap(*arguments)
        assert answer.returncode == 0
        assert answer.stdout.startswith("files without a row: 0")


def test_check_of_a_store_that_lacks_a_run(fluoromap: Program, first_token: str, tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "data" / "fluoromap.sqlite")) as database, database:
        database.execute("INSERT INTO file (sha256) VALUES (?)", ("f" * 64,))
        database.execute("INSERT INTO instance VALUES ('1.2.3', ?, '1', '2', '{}', 0)", ("f" * 64,))
    answer = fluoromap("check")
    assert "run 1.2.3: its file is damaged; upload it again" in answer.stdout
    assert "1 runs are damaged" in one_sentence(answer)


def test_audit_is_exported_and_verified(fluoromap: Program, first_token: str, tmp_path: Path) -> None:
    fluoromap("token", "revoke", "ada")
    lines = [json.loads(line) for line in fluoromap("audit", "export").stdout.splitlines()]
    assert [(line["who"], line["what"]) for line in lines] == [
        ("command line", "token create ada"),
        ("command line", "token revoke ada"),
    ]
    assert fluoromap("audit", "export", "trail.jsonl").returncode == 0
    assert len((tmp_path / "trail.jsonl").read_text().splitlines()) == 2
    assert lines[1]["hash"] in fluoromap("audit", "verify", "--head", lines[0]["hash"]).stdout
    with closing(sqlite3.connect(tmp_path / "data" / "fluoromap.sqlite")) as database, database:
        database.execute("DROP TRIGGER audit_no_UPDATE")
        database.execute("UPDATE audit SET who = 'eve' WHERE id = 1")
    assert "Entry 1" in one_sentence(fluoromap("audit", "verify"))
