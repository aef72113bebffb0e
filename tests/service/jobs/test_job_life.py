"""The life of jobs and stages on SQL alone: no Celery, no plugin."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import event as sql_event
from sqlalchemy import select, update

from fluoromap_service.jobs import job_life, living_workers, stall, turns
from fluoromap_service.settings import settings
from fluoromap_service.store import files
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import engine, reading, writing
from fluoromap_service.store.models import Base, Event, Job, JobState, StageRow, StageState, Study, WorkerSeen
from fluoromap_service.study.catheters import StudyCatheter
from fluoromap_service.study.snapshot import (
    GantrySnapshot,
    PluginSnapshot,
    RunSnapshot,
    SiteSnapshot,
    Snapshot,
)

GANTRY = GantrySnapshot(
    primary_deg=0, secondary_deg=0, source_detector_mm=1000, source_isocentre_mm=500,
    pixel_spacing_mm=(0.35, 0.35), rows=512, columns=512, image_axes=((1, 0), (0, 1)),
)  # fmt: skip


def _snapshot(study: str, sites: int = 2) -> Snapshot:
    plan = PluginSnapshot(name="p", version="1", params={})
    run = RunSnapshot(sha256="0" * 64, facts={}, gantry=GANTRY, corrections={})
    catheters = tuple(
        StudyCatheter(name=name, electrodes=4, spacing_mm=(3.5, 6, 3), tip_mm=2, ring_mm=1)
        for name in ("reference", "mapping")
    )
    plans = tuple(
        SiteSnapshot(site=f"S{i:02}", lat_ms=1.0 * i, lat_sd_ms=1.0, view_a=f"1.{i}.1", view_b=f"1.{i}.2")
        for i in range(1, sites + 1)
    )
    runs = {uid: run for plan_ in plans for uid in (plan_.view_a, plan_.view_b)}
    return Snapshot(
        study=study, catheters=catheters, reference="reference", mapping="mapping", segmenter=plan, triangulator=plan,
        monoplane=plan, fuser=plan, view="both", runs=runs, sites=plans, rejected=(),
    )  # fmt: skip


@pytest.fixture(params=["sqlite", "postgresql"])
def job(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A committed job of two sites in an empty database."""
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("FLUOROMAP_LEASE_SECONDS", "30")
    if request.param == "postgresql":
        monkeypatch.setenv("FLUOROMAP_DATABASE_URL", request.getfixturevalue("postgres_url"))
    settings.cache_clear()
    Base.metadata.create_all(engine())
    with writing() as session:
        session.add(Study(id="s", label="x", catheters=[], reference="reference", mapping="mapping"))
        session.flush()
        created = job_life.create(session, "s", _snapshot("s"))
    yield created.id
    engine().dispose()
    settings.cache_clear()


def _stage_ids(job_id: str, name: str | None = None, state: StageState | None = None) -> list[int]:
    with reading() as session:
        query = select(StageRow.id).where(StageRow.job_id == job_id).order_by(StageRow.id)
        if name:
            query = query.where(StageRow.name == name)
        if state:
            query = query.where(StageRow.state == state)
        return list(session.scalars(query))


def _claim(stage_id: int, worker: str = "w") -> job_life.Claim | None:
    with writing() as session:
        return job_life.claim(session, stage_id, worker)


def _finish(held: job_life.Claim) -> bool:
    with writing() as session:
        sha256 = files.keep_bytes(session, b"{}")
        return job_life.finish(session, held, job_life.StoredResult(sha256), reused=False)


def _work(job_id: str, end: Callable[[job_life.Claim], object] = _finish, only: str | None = None) -> None:
    """Claim and end every ready stage, in order, until none is left."""
    while ready := _stage_ids(job_id, only, StageState.READY):
        held = _claim(ready[0])
        assert held is not None
        end(held)


def _job(job_id: str) -> Job:
    with reading() as session:
        return session.get_one(Job, job_id)


def _silence(stage_id: int) -> None:
    """Set the stage's heartbeat as if its worker had died long ago."""
    with writing() as session:
        session.execute(update(StageRow).where(StageRow.id == stage_id).values(lease_until=db_now() - 1))


def test_stages_run_in_order_and_the_job_succeeds(job: str) -> None:
    assert _job(job).state == JobState.QUEUED
    assert set(_stage_ids(job, state=StageState.READY)) == set(_stage_ids(job, "segment"))
    _work(job, only="segment")
    assert _stage_ids(job, state=StageState.READY) == _stage_ids(job, "match")
    assert _job(job).state == JobState.RUNNING
    _work(job)
    done = _job(job)
    assert done.state == JobState.SUCCEEDED
    assert done.started is not None
    assert done.finished is not None
    assert done.finished >= done.started


def test_a_ready_stage_is_announced_once_and_again_only_after_a_while(job: str) -> None:
    with writing() as session:
        assert sorted(turns.take_due(session)) == _stage_ids(job, "segment")
    with writing() as session:
        assert turns.take_due(session) == []
        session.execute(update(StageRow).values(published=db_now() - 100))
    with writing() as session:
        assert sorted(turns.take_due(session)) == _stage_ids(job, "segment")


def test_few_stages_are_announced_at_once(job: str) -> None:
    segments = _stage_ids(job, "segment")
    announced: list[int] = []
    for _ in segments:
        with writing() as session:
            announced += turns.take_due(session, limit=1)
    assert sorted(announced) == segments


def test_a_stage_is_claimed_once(job: str) -> None:
    stage = _stage_ids(job, "segment")[0]
    assert _claim(stage) is not None
    assert _claim(stage) is None
    assert _claim(10**9) is None


def test_two_stages_that_finish_together_start_their_child(job: str) -> None:
    """Without the job's lock each would see the other unfinished and the child would never start."""
    segments = _stage_ids(job, "segment")
    for stage in segments[:-2]:
        held = _claim(stage)
        assert held is not None
        _finish(held)
    last = [_claim(stage) for stage in segments[-2:]]
    barrier = threading.Barrier(2)

    def together(held: job_life.Claim) -> None:
        barrier.wait()
        _finish(held)

    threads = [threading.Thread(target=together, args=(held,)) for held in last if held]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert _stage_ids(job, state=StageState.READY) == _stage_ids(job, "match")


def test_a_dead_workers_stage_is_free_again_and_its_late_output_thrown_away(job: str) -> None:
    stage = _stage_ids(job, "segment")[0]
    dead = _claim(stage, "dead")
    assert dead is not None
    _silence(stage)
    with writing() as session:
        assert job_life.reap(session) == 1
    alive = _claim(stage, "alive")
    assert alive is not None
    assert alive.attempt == 2
    assert not _finish(dead)
    with writing() as session:
        assert job_life.beat(session, dead, 0.5) == "lost"
        assert job_life.beat(session, alive, 0.5) == "alive"
    assert _finish(alive)


def test_a_stage_whose_workers_keep_dying_fails_with_the_reason_and_the_job_goes_on(job: str) -> None:
    stage = _stage_ids(job, "segment")[0]
    for _ in range(settings().max_attempts):
        assert _claim(stage) is not None
        _silence(stage)
        with writing() as session:
            job_life.reap(session)
    with reading() as session:
        row = session.get_one(StageRow, stage)
        assert row.state == StageState.FAILED
        assert row.error is not None
        assert row.error["code"] == "worker_lost"
    _work(job)
    assert _job(job).state == JobState.SUCCEEDED


def test_a_living_worker_is_not_reaped(job: str) -> None:
    assert _claim(_stage_ids(job, "segment")[0]) is not None
    with writing() as session:
        assert job_life.reap(session) == 0


@pytest.mark.parametrize("broken", ["match", "triangulate", "fuse"])
def test_a_stage_the_study_needs_fails_the_job(job: str, broken: str) -> None:
    def end(held: job_life.Claim) -> None:
        if held.name != broken:
            _finish(held)
            return
        with writing() as session:
            assert job_life.fail(session, held, {"code": "plugin_failed", "detail": "no"})

    _work(job, end)
    ended = _job(job)
    assert ended.state == JobState.FAILED
    assert ended.error is not None
    assert ended.error["detail"] == "no"
    monoplane = {StageState.DONE} if broken == "fuse" else {StageState.CANCELLED}
    with reading() as session:
        states = session.scalars(select(StageRow.state).where(StageRow.name == "monoplane")).all()
    assert set(states) == monoplane


def test_a_job_fails_when_all_its_runs_failed(job: str) -> None:
    def end(held: job_life.Claim) -> None:
        with writing() as session:
            assert job_life.fail(session, held, {"code": "worker_lost", "detail": "the worker died"})

    _work(job, end, "segment")
    with reading() as session:
        ended = session.get_one(Job, job)
        states = {row.name: row.state for row in session.scalars(select(StageRow).where(StageRow.job_id == job))}
    assert ended.state == JobState.FAILED
    assert ended.error is not None
    assert ended.error["code"] == "worker_lost"
    assert set(states.values()) == {StageState.FAILED, StageState.CANCELLED}


def test_a_failed_single_view_fails_its_site_only(job: str) -> None:
    def end(held: job_life.Claim) -> None:
        if held.name != "monoplane":
            _finish(held)
            return
        with writing() as session:
            job_life.fail(session, held, {"code": "plugin_failed", "detail": "no"})

    _work(job, end)
    assert _job(job).state == JobState.SUCCEEDED


def test_cancelling_stops_what_waits_at_once_and_what_runs_at_its_next_check(job: str) -> None:
    held = _claim(_stage_ids(job, "segment")[0])
    assert held is not None
    with writing() as session:
        assert job_life.cancel(session, job)
    assert _job(job).state == JobState.RUNNING
    with writing() as session:
        assert job_life.beat(session, held, 0.1) == "cancelled"
        job_life.stopped(session, held)
    assert _job(job).state == JobState.CANCELLED
    with writing() as session:
        assert not job_life.cancel(session, job)


def test_cancelling_a_job_whose_worker_died_ends_it(job: str) -> None:
    stage = _stage_ids(job, "segment")[0]
    assert _claim(stage) is not None
    with writing() as session:
        job_life.cancel(session, job)
    _silence(stage)
    with writing() as session:
        job_life.reap(session)
    assert _job(job).state == JobState.CANCELLED


def test_every_change_is_an_event_in_order(job: str) -> None:
    _work(job)
    with reading() as session:
        events = session.scalars(select(Event).where(Event.job_id == job).order_by(Event.id)).all()
    assert [event.data["state"] for event in events if event.kind == "job"] == ["queued", "running", "succeeded"]
    stages: dict[tuple[str, str], list[str]] = {}
    for event in events:
        if event.kind == "stage":
            stages.setdefault((event.data["name"], event.data["subject"]), []).append(event.data["state"])
    assert len(stages) == len(_stage_ids(job))
    for states in stages.values():
        assert [state for state, _ in itertools.groupby(states)][-2:] == ["running", "done"]


def _move_clock_back(seconds: float) -> None:
    """Move all stored times of the queue into the future.

    The effect is the same as when somebody sets the database's clock back.
    """
    with writing() as session:
        session.execute(
            update(StageRow).values(lease_until=StageRow.lease_until + seconds, published=StageRow.published + seconds)
        )


def test_a_dead_workers_stage_is_freed_although_the_clock_was_set_back(job: str) -> None:
    stage = _stage_ids(job, "segment")[0]
    held = _claim(stage)
    assert held is not None
    _move_clock_back(3600)
    with writing() as session:
        assert job_life.reap(session) == 0
    with reading() as session:
        lease = session.get_one(StageRow, stage).lease_until
        now = session.scalar(select(db_now()))
    assert lease is not None
    assert now is not None
    assert lease <= now + settings().lease_seconds
    # The worker lives and keeps its claim.
    with writing() as session:
        assert job_life.beat(session, held, 0.5) == "alive"
    _silence(stage)
    with writing() as session:
        assert job_life.reap(session) == 1


def test_a_lost_announcement_is_repeated_although_the_clock_was_set_back(job: str) -> None:
    with writing() as session:
        assert turns.take_due(session)
    _move_clock_back(3600)
    with writing() as session:
        assert sorted(turns.take_due(session)) == _stage_ids(job, "segment")


def test_a_stage_that_is_given_back_is_ready_at_once(job: str) -> None:
    stage = _stage_ids(job, "segment")[0]
    held = _claim(stage)
    assert held is not None
    with writing() as session:
        job_life.give_back(session, held)
    assert stage in _stage_ids(job, "segment", StageState.READY)
    # A claim that was lost gives nothing back.
    assert _claim(stage) is not None
    with writing() as session:
        job_life.give_back(session, held)
    assert stage in _stage_ids(job, "segment", StageState.RUNNING)


def test_a_worker_lives_while_it_gives_signs_of_life(job: str) -> None:
    with writing() as session:
        living_workers.worker_seen(session, "first")
        assert (living_workers.living_workers(session), living_workers.living_workers(session, "second")) == (1, 0)
    for seconds in (-3600, 3600):
        with writing() as session:
            session.execute(update(WorkerSeen).values(seen=db_now() + seconds))
            assert living_workers.living_workers(session) == 0


def test_ready_stages_that_nobody_runs_are_a_stall(job: str) -> None:
    clock = itertools.count(0.0, 15.0)
    watch = stall.StallWatch(clock.__next__)
    assert stall.stall_seconds() == 20

    def look() -> bool:
        with reading() as session:
            return watch.look(session)

    assert [look() for _ in range(3)] == [False, False, True]
    held = _claim(_stage_ids(job, "segment")[0])
    assert [look(), look()] == [False, False]
    assert held is not None
    with writing() as session:
        job_life.beat(session, held, 0.5)
    assert [look(), look()] == [False, False]
    watch.reset()
    assert [look(), look()] == [False, True]


def _take() -> tuple[str, str] | None:
    """Claim and end the most urgent stage; return its job and name."""
    with writing() as session:
        urgent = turns.most_urgent(session)
        if urgent is None:
            return None
        held = job_life.claim(session, urgent.stage_id, "w")
    assert held is not None
    assert _finish(held)
    return held.job_id, held.name


def test_a_small_job_does_not_wait_for_a_large_one_and_the_map_comes_first(job: str) -> None:
    with writing() as session:
        large = job_life.create(session, "s", _snapshot("s", sites=10)).id
        # The job of the fixture takes no part.
        assert job_life.cancel(session, job)
    order = [_take() for _ in range(3)]
    assert order == [(large, "segment")] * 3
    with writing() as session:
        small = job_life.create(session, "s", _snapshot("s", sites=1)).id
    while taken := _take():
        order.append(taken)
    # The newcomer has fewer stages left: all of it is done before the large study goes on.
    assert order[3:9] == [(small, name) for name in ("segment", "segment", "match", "triangulate", "fuse", "monoplane")]
    # No monoplane stage is taken while the map of any job can be made.
    names = [name for owner, name in order if owner == large]
    assert names == ["segment"] * 20 + ["match", "triangulate", "fuse"] + ["monoplane"] * 10


def test_a_map_of_another_job_comes_before_the_tracks(job: str) -> None:
    """``fuse`` waits for no stage about a site, however few stages the job of that site has left."""
    with writing() as session:
        large = job_life.create(session, "s", _snapshot("s", sites=10)).id
    _work(large, only="segment")
    for name in ("match", "triangulate"):
        assert _take() == (large, name)
    _work(job, only="segment")
    for name in ("match", "triangulate"):
        _work(job, only=name)
    assert {_take(), _take()} == {(large, "fuse"), (job, "fuse")}
    assert [_take() for _ in range(2)] == [(job, "monoplane")] * 2


def test_a_correction_counts_only_the_stages_that_are_not_known(job: str) -> None:
    """A new job is opened first; when its known stages have ended, it has few left."""
    _work(job, only="segment")
    with writing() as session:
        other = job_life.create(session, "s", _snapshot("s", sites=3)).id
        corrected = job_life.create(session, "s", _snapshot("s", sites=10)).id
        sha256 = files.keep_bytes(session, b"{}")
        known = job_life.ready(session, corrected)[1:]
        job_life.finish_ready(session, corrected, [(claim, job_life.StoredResult(sha256)) for claim in known])
    assert [_take() for _ in range(3)] == [(job, name) for name in ("match", "triangulate", "fuse")]
    # Two new jobs: each begins, the older one first.
    assert [_take() for _ in range(2)] == [(other, "segment"), (corrected, "segment")]
    assert _take() == (corrected, "match")


def test_no_job_waits_for_ever(job: str) -> None:
    """Age counts as stages that are done."""
    with writing() as session:
        large = job_life.create(session, "s", _snapshot("s", sites=10)).id
        assert job_life.cancel(session, job)
    assert _take() == (large, "segment")
    with writing() as session:
        age = 100 * turns.AGE_OF_A_STAGE_SECONDS
        session.execute(update(Job).where(Job.id == large).values(created=Job.created - age))
        small = job_life.create(session, "s", _snapshot("s", sites=1)).id
    assert _take() == (small, "segment")
    assert _take() == (large, "segment")


def test_the_end_of_a_stage_does_not_read_the_others(job: str) -> None:
    """The states of a job's stages are counted; only a change of kind reads the rows."""
    with writing() as session:
        large = job_life.create(session, "s", _snapshot("s", sites=40)).id
    held = _claim(_stage_ids(large, "segment")[0])
    assert held is not None
    loaded: list[StageRow] = []

    def note(row: StageRow, context: object) -> None:
        loaded.append(row)

    sql_event.listen(StageRow, "load", note)
    try:
        assert _finish(held)
    finally:
        sql_event.remove(StageRow, "load", note)
    assert loaded == []
