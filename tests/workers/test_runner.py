"""One stage from claim to finish: whose fault ends how."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, event, select, update
from sqlalchemy.orm import Session

from fluoromap.contracts import Context, Refusal
from fluoromap.reasons import Reason
from fluoromap_service.jobs import queue
from fluoromap_service.jobs.job_life import Claim
from fluoromap_service.store import files
from fluoromap_service.store.codec import decode, encode
from fluoromap_service.store.engine import engine, reading, writing
from fluoromap_service.store.models import Event, Job, JobState, StageResult, StageRow, StageState, Study
from fluoromap_workers import runner, tasks
from fluoromap_workers.stage_inputs import PluginChanged, Work


@dataclass(frozen=True)
class _Answer:
    text: str = ""
    number: int = 0


@pytest.fixture
def stage(data_dir: Path) -> int:
    """A ready stage, the only one of its job."""
    with writing() as session:
        session.add(Study(id="s", label="x", catheters=[], reference="r", mapping="m"))
        session.flush()
        session.add(Job(id="j", study_id="s", state=JobState.QUEUED, snapshot={}))
        session.flush()
        row = StageRow(
            job_id="j", name="segment", subject="1.2.3", plugin="p", plugin_version="1", depends_on=[],
            state=StageState.READY,
        )  # fmt: skip
        session.add(row)
        session.flush()
        return row.id


def _run(stage: int, monkeypatch: pytest.MonkeyPatch, compute: Callable[[Context], Any]) -> StageRow:
    monkeypatch.setattr(runner, "_prepare", lambda session, held: Work("0" * 64, _Answer, compute, str))
    runner.run(stage, "test")
    with reading() as session:
        return session.get_one(StageRow, stage)


def _raises(error: Exception) -> Callable[[Any], Any]:
    def compute(context: Context) -> Any:
        raise error

    return compute


def test_a_result_is_stored_and_the_job_ends(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    row = _run(stage, monkeypatch, lambda context: _Answer("answer", 42))
    assert row.state == StageState.DONE
    assert row.result is not None
    assert decode(_Answer, files.path_of(row.result).read_bytes()) == _Answer("answer", 42)
    with reading() as session:
        assert session.get_one(Job, "j").state == JobState.SUCCEEDED


def test_a_worker_takes_stages_until_none_is_ready(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    with writing() as session:
        session.add(Job(id="other", study_id="s", state=JobState.QUEUED, snapshot={}))
        session.flush()
        for job, depends_on in (("j", [stage]), ("other", [])):
            state = StageState.PENDING if depends_on else StageState.READY
            row = StageRow(
                job_id=job,
                name="match",
                subject="s",
                plugin="p",
                plugin_version="1",
                depends_on=depends_on,
                state=state,
            )
            session.add(row)
    prepared = []

    def work(session: Session, held: Claim) -> Work:
        prepared.append((held.job_id, held.name))
        return Work("0" * 64, _Answer, lambda context: _Answer(), str)

    monkeypatch.setattr(runner, "_prepare", work)
    # No other message comes.
    monkeypatch.setattr(queue, "publish", lambda stage_ids: None)
    tasks.run_stage(stage)
    with reading() as session:
        states = {job.id: job.state for job in session.scalars(select(Job))}
    assert states == {"j": JobState.SUCCEEDED, "other": JobState.SUCCEEDED}
    # A match of any job comes before the segments.
    assert prepared == [("other", "match"), ("j", "segment"), ("j", "match")]


def _more_stages(count: int) -> list[int]:
    rows = [
        StageRow(
            job_id="j", name="segment", subject=f"1.2.{k}", plugin="p", plugin_version="1", depends_on=[],
            state=StageState.READY,
        )
        for k in range(10, 10 + count)
    ]  # fmt: skip
    with writing() as session:
        session.add_all(rows)
        session.flush()
        return [row.id for row in rows]


def test_what_was_computed_before_ends_at_once(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    known, removed, new = _more_stages(3)
    keys = {stage: "a", known: "a", removed: "b", new: "c"}
    computed = []

    def work(session: Session, held: Claim) -> Work:
        def compute(context: Context) -> _Answer:
            computed.append(held.stage_id)
            return _Answer(number=held.stage_id)

        return Work(keys[held.stage_id] * 64, _Answer, compute, str)

    monkeypatch.setattr(runner, "_prepare", work)
    runner.run(stage, "test")
    runner.run(removed, "test")
    with writing() as session:
        row = session.get_one(StageRow, removed)
        files.path_of(str(row.result)).unlink()
        row.state, row.result, row.reused = StageState.READY, None, False
    runner.finish_known("j")
    assert computed == [stage, removed]
    with reading() as session:
        rows = {number: session.get_one(StageRow, number) for number in keys}
        told = [
            (event.data["subject"], event.data["state"])
            for event in session.scalars(select(Event))
            if event.data.get("reused")
        ]
    assert rows[known].state == StageState.DONE
    assert rows[known].result == rows[stage].result
    assert rows[known].reused
    assert told == [("1.2.10", "done")]
    assert rows[removed].state == StageState.READY
    assert rows[new].state == StageState.READY


def _statements_to_end(count: int, monkeypatch: pytest.MonkeyPatch) -> tuple[int, int]:
    """Return the SQL statements and the parsed snapshots of ending ``count`` known stages."""
    stages = _more_stages(count)
    parsed, statements = [], []

    def parse(snapshot: object) -> object:
        parsed.append(snapshot)
        return snapshot

    def note(*arguments: object) -> None:
        statements.append(arguments[2])

    monkeypatch.setattr(runner.Snapshot, "model_validate", parse)
    monkeypatch.setattr(runner, "prepare", lambda job, claim: Work("d" * 64, _Answer, _never, str))
    runner._snapshot.cache_clear()
    with writing() as session:
        sha256 = files.keep_bytes(session, encode(_Answer()))
        session.merge(StageResult(key="d" * 64, sha256=sha256))
    event.listen(engine(), "before_cursor_execute", note)
    try:
        runner.finish_known("j")
    finally:
        event.remove(engine(), "before_cursor_execute", note)
        runner._snapshot.cache_clear()
    with reading() as session:
        assert {session.get_one(StageRow, number).state for number in stages} == {StageState.DONE}
    return len(statements), len(parsed)


def _never(context: Context) -> Any:
    raise AssertionError("computed again")


@pytest.mark.usefixtures("stage")
def test_ending_known_stages_costs_the_same_statements_for_few_and_many(monkeypatch: pytest.MonkeyPatch) -> None:
    few, parsed_for_few = _statements_to_end(4, monkeypatch)
    with writing() as session:
        session.execute(update(Job).values(state=JobState.RUNNING))
        session.execute(delete(StageRow))
    many, parsed_for_many = _statements_to_end(300, monkeypatch)
    assert few == many
    assert parsed_for_few == parsed_for_many == 1


def test_a_stage_that_cannot_be_prepared_does_not_keep_the_worker_from_the_others(
    stage: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    (broken,) = _more_stages(1)

    def work(session: Session, held: Claim) -> Work:
        if held.stage_id == broken:
            raise ValueError("a stored result is damaged")
        return Work("0" * 64, _Answer, lambda context: _Answer(), str)

    monkeypatch.setattr(runner, "_prepare", work)
    monkeypatch.setattr(queue, "publish", lambda stage_ids: None)
    tasks.run_stage(stage)
    with reading() as session:
        assert session.get_one(StageRow, stage).state == StageState.DONE
        assert session.get_one(StageRow, broken).state == StageState.FAILED


@pytest.mark.parametrize("error", [ValueError("no electrode"), OSError("the plugin's own file")])
def test_a_plugin_that_raises_fails_its_stage_in_its_own_words(
    stage: int, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    row = _run(stage, monkeypatch, _raises(error))
    assert row.state == StageState.FAILED
    assert row.error is not None
    assert row.error["code"] == "plugin_failed"
    assert str(error) in row.error["detail"]


def test_a_plugin_of_another_version_is_not_run(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    row = _run(stage, monkeypatch, _raises(PluginChanged("The job was made with version 1.")))
    assert row.state == StageState.FAILED
    assert row.error == {"code": "plugin_changed", "detail": "The job was made with version 1."}


def test_a_full_disk_leaves_the_stage_to_another_attempt(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: Any, **named: Any) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "keep", full)
    row = _run(stage, monkeypatch, lambda context: _Answer())
    assert row.state == StageState.RUNNING
    assert row.lease_until is not None
    assert list((files.path_of("00").parent.parent / "incoming").iterdir()) == []


def test_a_fault_of_the_service_is_not_blamed_on_the_plugin(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: Any, **named: Any) -> str:
        raise RuntimeError("a name that must stay secret")

    monkeypatch.setattr(files, "keep", broken)
    row = _run(stage, monkeypatch, lambda context: _Answer())
    assert row.state == StageState.FAILED
    assert row.error is not None
    assert row.error["code"] == "internal"
    assert "name" not in row.error["detail"]


def test_a_reused_result_is_not_copied(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    (again,) = _more_stages(1)
    monkeypatch.setattr(
        runner, "_prepare", lambda session, claim: Work("0" * 64, _Answer, lambda context: _Answer("", 1), str)
    )
    runner.run(stage, "test")
    with reading() as session:
        path = files.path_of(str(session.get_one(StageRow, stage).result))
    before = path.stat().st_ino, path.stat().st_mtime_ns

    def copied(*arguments: Any) -> str:
        raise AssertionError("a stored result was written again")

    monkeypatch.setattr(files, "keep", copied)
    runner.run(again, "test")
    with reading() as session:
        row = session.get_one(StageRow, again)
    assert (row.state, row.reused) == (StageState.DONE, True)
    # The check of its hash reads the file, which changes its access time only.
    assert (path.stat().st_ino, path.stat().st_mtime_ns) == before


def test_a_refusal_is_a_result_like_any_other(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(context: Context) -> Any:
        raise Refusal(Reason.NO_ELECTRODES, "Nothing to see.")

    work = Work("0" * 64, _Answer, refuse, lambda refusal: _Answer(f"{refusal.reason}: {refusal}"))
    monkeypatch.setattr(runner, "_prepare", lambda session, claim: work)
    runner.run(stage, "test")
    with reading() as session:
        row = session.get_one(StageRow, stage)
    assert row.state == StageState.DONE
    content = files.path_of(str(row.result)).read_bytes()
    assert decode(_Answer, content) == _Answer("no_electrodes: Nothing to see.")


def test_a_result_that_comes_late_is_thrown_away(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def overtaken(context: Context) -> _Answer:
        with writing() as session:
            session.get_one(StageRow, stage).attempt += 1
        return _Answer("late")

    row = _run(stage, monkeypatch, overtaken)
    assert row.state == StageState.RUNNING
    assert row.result is None


def test_a_damaged_stored_result_is_computed_again(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    row = _run(stage, monkeypatch, lambda context: _Answer("answer", 42))
    assert row.result is not None
    files.path_of(row.result).write_bytes(b"damaged")
    with writing() as session:
        session.get_one(StageRow, stage).state = StageState.READY
    row = _run(stage, monkeypatch, lambda context: _Answer("answer", 42))
    assert (row.state, row.reused) == (StageState.DONE, False)
    assert row.result is not None
    assert files.is_whole(row.result)


def test_a_damaged_input_fails_the_stage_by_name(stage: int, monkeypatch: pytest.MonkeyPatch) -> None:
    row = _run(stage, monkeypatch, _raises(files.BrokenFile("0" * 64)))
    assert (row.state, (row.error or {})["code"]) == (StageState.FAILED, "input_broken")
