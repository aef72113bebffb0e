"""The chain of the audit trail: the database refuses changes, and a changed entry is found."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError

from fluoromap_service.settings import settings
from fluoromap_service.store import audit, schema
from fluoromap_service.store.audit import Act, BrokenChain
from fluoromap_service.store.engine import engine, forget_engine, reading, writing


@pytest.fixture(params=["sqlite", "postgresql"])
def trail(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The hashes of three entries in a migrated database."""
    url = request.getfixturevalue("postgres_url") if request.param == "postgresql" else ""
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", url)
    settings.cache_clear()
    schema.upgrade()
    for number in range(3):
        with writing() as session:
            audit.append(session, [Act("ada", f"GET /{number}", study="s" * 32, status=200)])
    with reading() as session:
        hashes = [entry.hash for entry in audit.entries(session)]
    yield hashes
    forget_engine()
    settings.cache_clear()


def _verify(head: str | None = None) -> tuple[int, str]:
    with reading() as session:
        return audit.verify(session, head)


@pytest.mark.parametrize("statement", ["UPDATE audit SET who = 'eve' WHERE id = 2", "DELETE FROM audit"])
def test_the_database_refuses_changes(trail: list[str], statement: str) -> None:
    with pytest.raises(DBAPIError, match="append-only"), writing() as session:
        session.execute(text(statement))
    assert _verify() == (3, trail[-1])


def _without_triggers(statement: str) -> None:
    with engine().execution_options(writes=True).begin() as connection:
        if engine().dialect.name == "sqlite":
            connection.execute(text("DROP TRIGGER audit_no_UPDATE"))
            connection.execute(text("DROP TRIGGER audit_no_DELETE"))
        else:
            connection.execute(text("ALTER TABLE audit DISABLE TRIGGER USER"))
        connection.execute(text(statement))


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE audit SET who = 'eve' WHERE id = 2",
        "UPDATE audit SET study = NULL WHERE id = 1",
        "DELETE FROM audit WHERE id = 1",
        "DELETE FROM audit WHERE id = 2",
    ],
)
def test_a_change_breaks_the_chain(trail: list[str], statement: str) -> None:
    _without_triggers(statement)
    with pytest.raises(BrokenChain):
        _verify()


def test_a_missing_end_is_found_with_an_earlier_hash(trail: list[str]) -> None:
    assert _verify(trail[1]) == (3, trail[2])
    _without_triggers("DELETE FROM audit WHERE id = 3")
    assert _verify() == (2, trail[1])
    with pytest.raises(BrokenChain, match="end was removed"):
        _verify(trail[2])
