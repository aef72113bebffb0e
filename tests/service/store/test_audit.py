"""The chain of the audit trail: the database refuses changes, and a changed entry is found."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError
from typer.testing import CliRunner

from fluoromap_service.cli.commands.audit import app as command
from fluoromap_service.settings import settings
from fluoromap_service.store import audit, schema
from fluoromap_service.store.audit import Act, BrokenChain
from fluoromap_service.store.audit_head import Head, HeadWatch, published_hashes
from fluoromap_service.store.engine import engine, forget_engine, reading, writing
from fluoromap_service.store.models import AuditEntry


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


def _verify(*heads: str) -> tuple[int, str]:
    with reading() as session:
        return audit.verify(session, heads)


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


def _write_anew() -> None:
    """Remove the second entry and make the chain fit again."""
    _without_triggers("DELETE FROM audit WHERE id = 2")
    with engine().execution_options(writes=True).begin() as connection:
        before = audit.START
        for row in connection.execute(text("SELECT * FROM audit ORDER BY id")).mappings().all():
            before = audit._hash(before, AuditEntry(**{**row, "hash": ""}))
            connection.execute(text("UPDATE audit SET hash = :hash WHERE id = :id"), {"hash": before, "id": row["id"]})


@pytest.mark.parametrize("how", ["tail", "emptied", "written anew"])
def test_what_the_chain_cannot_show_is_found_with_the_published_head(
    trail: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    file = tmp_path / "heads.jsonl"
    monkeypatch.setenv("FLUOROMAP_AUDIT_HEAD_FILE", str(file))
    settings.cache_clear()
    watch = HeadWatch()
    watch.publish()
    watch.publish()
    assert published_hashes(file) == [trail[-1]]
    assert watch.published == Head(3, trail[-1])
    assert _verify(*published_hashes(file)) == (3, trail[-1])
    if how == "written anew":
        _write_anew()
    else:
        _without_triggers("DELETE FROM audit WHERE id = 3" if how == "tail" else "DELETE FROM audit")
    assert _verify()[0] == {"tail": 2, "emptied": 0, "written anew": 2}[how]
    with pytest.raises(BrokenChain, match="lacks 1 of the given hashes"):
        _verify(*published_hashes(file))
    watch.publish()
    assert watch.breaks == 1


def test_the_command_compares_with_a_hash_and_with_a_log(trail: list[str], tmp_path: Path) -> None:
    log = tmp_path / "api.log"
    lines = ["started", json.dumps({"event": "broken_file", "sha256": "f" * 64})]
    lines += [json.dumps({"event": "audit_head", "entry": 2, "head": trail[1]})]
    log.write_text("\n".join(lines))
    for given in (trail[0], str(log)):
        answer = CliRunner().invoke(command, ["verify", "--against", given])
        assert (answer.exit_code, "1 earlier hashes are in it" in answer.output) == (0, True)
    _without_triggers("DELETE FROM audit WHERE id > 1")
    assert CliRunner().invoke(command, ["verify"]).exit_code == 0
    assert CliRunner().invoke(command, ["verify", "--against", str(log)]).exit_code != 0
    for useless in (str(tmp_path / "none"), "abc", __file__):
        assert CliRunner().invoke(command, ["verify", "--against", useless]).exit_code != 0


def test_an_act_that_happened_often_is_one_entry_of_the_chain(trail: list[str]) -> None:
    with writing() as session:
        (entry,) = audit.append(session, [Act("ada", "GET /x", times=7)])
        assert audit.as_json(entry)["times"] == 7
    assert _verify()[0] == 4
    _without_triggers("UPDATE audit SET times = 6 WHERE id = 4")
    with pytest.raises(BrokenChain):
        _verify()
