"""The last change of a database: the same until somebody commits, another one afterwards."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest
from sqlalchemy import select

from fluoromap_service.settings import settings
from fluoromap_service.store.changes import last_change
from fluoromap_service.store.engine import forget_engine, reading, writing
from fluoromap_service.store.models import File


def _commit(sha256: str) -> None:
    with writing() as session:
        session.add(File(sha256=sha256))


def test_reading_changes_nothing(data_dir: Path) -> None:
    before = last_change()
    assert before is not None
    with reading() as session:
        session.scalars(select(File)).all()
    assert last_change() == before


def test_each_commit_is_another_change(data_dir: Path) -> None:
    changes = [last_change()]
    for number in range(3):
        _commit(str(number))
        changes.append(last_change())
    assert len(set(changes)) == 4


def test_a_change_counts_from_its_commit_on(data_dir: Path) -> None:
    before = last_change()
    with writing() as session:
        session.add(File(sha256="x"))
        session.flush()
        assert last_change() == before
        session.rollback()
    assert last_change() == before


def test_another_program_commits(data_dir: Path) -> None:
    before = last_change()
    other = sqlite3.connect(data_dir / "fluoromap.sqlite")
    other.execute("INSERT INTO file (sha256) VALUES ('x')")
    other.commit()
    other.close()
    assert last_change() != before


def test_changes_of_two_engines_are_never_equal(data_dir: Path) -> None:
    before = last_change()
    forget_engine()
    after = last_change()
    assert after is not None
    assert after != before


def test_a_database_that_cannot_say(postgres_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", postgres_url)
    settings.cache_clear()
    assert last_change() is None
