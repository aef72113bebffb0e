"""The migrations make the tables that the models describe, however many processes ask at once."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import create_engine, inspect, select, text

from fluoromap_service import auth
from fluoromap_service.jobs import job_life
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings
from fluoromap_service.store import engine as store_engine
from fluoromap_service.store import schema
from fluoromap_service.store.engine import engine, forget_engine, reading, writing
from fluoromap_service.store.models import (
    Base,
    Correction,
    Event,
    File,
    Idempotency,
    Instance,
    Job,
    Point,
    Site,
    Study,
    StudyInstance,
)
from fluoromap_service.study import studies

FIRST_ROWS = (
    f"INSERT INTO file VALUES ('{'f' * 64}', 10, 'application/dicom', 1.0)",
    "INSERT INTO study VALUES ('s1', 'label', NULL, NULL, '[]', 'reference', 'mapping', '2.25.1', 1.0, 1.0)",
    f"INSERT INTO instance VALUES ('1.2.3', '{'f' * 64}', '1.2', '1.3', 7, NULL, '{{\"frames\": 3}}', 1.0)",
    "INSERT INTO study_instance (study_id, sop_instance_uid, gantry, added) VALUES ('s1', '1.2.3', '{}', 1.0)",
    "INSERT INTO mark (study_id, sop_instance_uid, frame, version, author, created)"
    " VALUES ('s1', '1.2.3', 4, 1, 'tester', 1.0)",
    "INSERT INTO site (study_id, name, lat_ms, lat_by, csv_row) VALUES ('s1', 'S01', 41.5, 'csv', 1)",
    "INSERT INTO job (id, study_id, state, version, manifest, cancel_requested, created, started)"
    """ VALUES ('j1', 's1', 'running', 3, '{"runs": {"1.2.3": {"marks": {"4": []}}}}', FALSE, 2.0, 3.0)""",
    "INSERT INTO stage (job_id, name, subject, plugin, plugin_version, depends_on, state, attempt, publications, progress,"
    f" reused, result) VALUES ('j1', 'segment', '1.2.3', 'p', '1', '[]', 'ready', 1, 2, 0.5, FALSE, '{'f' * 64}')",
    "INSERT INTO point (job_id, site, catheter, electrode, position_mm, grade, relative_grade, reasons)"
    " VALUES ('j1', 'S01', 'mapping', 1, '[1, 2, 3]', 'A', 'A', '[]')",
    "INSERT INTO event (job_id, kind, data, created) VALUES ('j1', 'job', '{}', 1.0)",
    "INSERT INTO token (name, sha256, scopes, created)"
    f" VALUES ('first', '{hashlib.sha256(b'secret').hexdigest()}', '[\"admin\"]', 1.0)",
    "INSERT INTO idempotency (key, request_sha256, status, body, created) VALUES ('k', 'c', 201, 'label', 1.0)",
)
"""Rows of the first schema: a run in a study with a corrected frame, a running job, a token and a stored answer."""


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    url = request.getfixturevalue("postgres_url") if request.param == "postgresql" else ""
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", url)
    settings.cache_clear()
    yield request.param
    engine().dispose()
    store_engine._engine.cache_clear()
    settings.cache_clear()


@pytest.mark.usefixtures("database")
def test_migrated_schema_equals_the_models() -> None:
    schema.upgrade()
    with engine().connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True, "compare_server_default": True})
        assert compare_metadata(context, Base.metadata) == []


@pytest.mark.usefixtures("database")
def test_upgrading_again_changes_nothing_and_keeps_the_rows() -> None:
    schema.upgrade()
    with writing() as session:
        session.add(Study(id="s1", label="x", catheters=[], reference="reference", mapping="mapping"))
    schema.upgrade()
    with reading() as session:
        assert session.get_one(Study, "s1").label == "x"


def test_sqlite_still_holds_foreign_keys_after_an_upgrade(database: str) -> None:
    schema.upgrade()
    if database == "sqlite":
        with engine().connect() as connection:
            assert connection.execute(text("PRAGMA foreign_keys")).scalar() == 1
    with pytest.raises(Exception, match=r"(?i)foreign key"), writing() as session:
        session.add(StudyInstance(study_id="none", sop_instance_uid="1.2", gantry={}))


@pytest.mark.usefixtures("database")
def test_processes_that_migrate_at_once_all_succeed() -> None:
    program = "from fluoromap_service.store.schema import upgrade; upgrade()"
    started = [subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.PIPE) for _ in range(3)]
    errors = [process.communicate()[1].decode() for process in started]
    assert [process.returncode for process in started] == [0, 0, 0], errors
    assert set(inspect(engine()).get_table_names()) == {*Base.metadata.tables, "alembic_version"}


def test_a_process_waits_for_a_long_migration_of_another_one(
    postgres_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PostgreSQL ends every other wait for a lock soon."""
    monkeypatch.setitem(store_engine.POSTGRESQL, "options", "-c lock_timeout=50ms")
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", postgres_url)
    settings.cache_clear()
    waits = text(
        "SELECT count(*) FROM pg_stat_activity WHERE wait_event_type = 'Lock' AND datname = current_database()"
        " AND clock_timestamp() - query_start > interval '200 ms'"
    )
    other = create_engine(postgres_url)
    try:
        with ThreadPoolExecutor(1) as threads, other.connect() as migrating, other.connect() as watching:
            migrating.execute(text("SELECT pg_advisory_lock(:lock)"), {"lock": schema._POSTGRESQL_LOCK})
            upgrade = threads.submit(schema.upgrade)
            while not upgrade.done() and not watching.scalar(waits):
                watching.rollback()
            migrating.execute(text("SELECT pg_advisory_unlock(:lock)"), {"lock": schema._POSTGRESQL_LOCK})
            upgrade.result()
        with engine().connect() as connection:
            assert connection.scalar(text("SHOW lock_timeout")) == "50ms"
    finally:
        other.dispose()
        forget_engine()
        settings.cache_clear()


def test_history_is_one_line() -> None:
    assert len(ScriptDirectory.from_config(schema.configuration()).get_heads()) == 1


def test_rows_of_the_first_schema_stay(database: str) -> None:
    _make_first_schema()
    schema.upgrade()
    with reading() as session:
        instance = session.get_one(Instance, "1.2.3")
        assert (instance.sha256, instance.facts) == ("f" * 64, {"frames": 3})
        assert session.get_one(File, "f" * 64)
        assert session.scalars(select(StudyInstance.sop_instance_uid)).all() == ["1.2.3"]
        assert session.scalars(select(Correction.frame)).all() == [4]
        site = session.scalars(select(Site)).one()
        assert (site.name, site.lat_ms) == ("S01", 41.5)
        job = session.get_one(Job, "j1")
        assert (job.state, job.created, job.snapshot["runs"]["1.2.3"]["corrections"]) == ("running", 2.0, {"4": []})
        assert session.scalars(select(Point.position_mm)).all() == [[1, 2, 3]]
        assert session.scalars(select(Event.kind)).all() == ["job"]
        # Such an answer named no study, so nothing could delete it with the study.
        assert session.scalars(select(Idempotency.id)).all() == []
    caller = auth.verify("secret")
    assert caller is not None
    assert caller.name == "first"


@pytest.mark.usefixtures("database")
def test_a_job_of_the_first_schema_goes_on() -> None:
    _make_first_schema()
    schema.upgrade()
    with writing() as session:
        (stage,) = job_life.ready(session, "j1")
        held = job_life.claim(session, stage.stage_id, "tester")
        assert held is not None
        assert job_life.fail(session, held, {"code": "plugin_failed", "detail": "It failed."})
    with reading() as session:
        assert session.get_one(Job, "j1").state == "failed"
    with writing() as session:
        studies.remove(session, "s1")
    with reading() as session:
        assert session.scalars(select(Job.id)).all() == session.scalars(select(Study.id)).all() == []


def _make_first_schema() -> None:
    config = schema.configuration()
    with schema._alone() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0001")
        for statement in FIRST_ROWS:
            connection.exec_driver_sql(statement)


@pytest.mark.usefixtures("database")
def test_missing_and_newer_tables_are_refused_in_a_sentence() -> None:
    with pytest.raises(Problem, match="db upgrade"):
        schema.check()
    schema.upgrade()
    schema.check()
    with engine().begin() as connection:
        connection.execution_options(writes=True).execute(text("UPDATE alembic_version SET version_num = '9999'"))
    for refuse in (schema.check, schema.upgrade):
        with pytest.raises(Problem, match="newer version"):
            refuse()
