"""The life of jobs and stages. SQL is the truth; a message only says that a row may be claimed.

Every function works inside the caller's transaction and locks the job's row first. So two stages that finish together see
each other, and no two transactions wait for each other.
"""

from __future__ import annotations

import itertools
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import Row, delete, insert, select, update
from sqlalchemy.orm import Session, defer

from fluoromap_service.jobs.pipeline import PIPELINE, STAGES, StageName, after, plugin_of, subjects_of
from fluoromap_service.settings import settings
from fluoromap_service.store import tally
from fluoromap_service.store.clock import CLOCK_TOLERANCE_SECONDS, db_now
from fluoromap_service.store.models import (
    ENDED_JOB,
    ENDED_STAGE,
    Event,
    Job,
    JobState,
    Json,
    Point,
    StageRow,
    StageState,
)
from fluoromap_service.study.snapshot import Snapshot

_REPORTED = (
    StageRow.name, StageRow.subject, StageRow.state, StageRow.attempt, StageRow.progress, StageRow.reused,
)  # fmt: skip
"""Columns of a stage that its events report."""

_REUSED = {"state": StageState.DONE, "progress": 1.0, "reused": True}
"""Columns of a stage that ended with a stored result, as its row and its event have them."""

SECONDS_BUCKETS = (0.1, 1.0, 5.0, 15.0, 60.0, 300.0, 1800.0)
"""Upper limits of the histogram of stage durations, in seconds."""

_INSERT_POINTS = Point.__table__.insert()  # type: ignore[attr-defined]
_INSERT_STAGES = StageRow.__table__.insert()  # type: ignore[attr-defined]

_INPUT_BROKEN = {
    "code": "input_broken",
    "detail": "A stored file that this stage reads is damaged. Upload the runs of this study again, then start a new job; "
    "'fluoromap check' names the damaged files.",
}


@dataclass(frozen=True, slots=True)
class Claim:
    """The right to run a stage, until its lease ends."""

    stage_id: int
    job_id: str
    attempt: int
    name: str
    subject: str


@dataclass(frozen=True, slots=True)
class StoredResult:
    """A stage's result in the store: the hash of its file, and the columns of the points that belong to it."""

    sha256: str
    points: tuple[Json, ...] = ()


def create(session: Session, study_id: str, snapshot: Snapshot) -> Job:
    """Add a job with all its stages. The first ones are ready."""
    job = Job(
        id=uuid.uuid4().hex,
        study_id=study_id,
        state=JobState.QUEUED,
        snapshot=snapshot.model_dump(mode="json"),
    )
    session.add(job)
    session.flush()
    now = session.scalar(select(db_now()))
    ids: dict[StageName, list[int]] = {}
    for stage in PIPELINE:
        depends_on = [number for name in stage.depends_on for number in ids[name]]
        plugin = plugin_of(stage, snapshot)
        rows = [
            {
                "job_id": job.id, "name": stage.name, "subject": subject, "plugin": plugin.name, "plugin_version": plugin.version,
                "depends_on": depends_on, "state": StageState.PENDING if depends_on else StageState.READY,
                "ready_since": None if depends_on else now,
            }
            for subject in subjects_of(stage, snapshot)
        ]  # fmt: skip
        # A study may have hundreds of runs, and the mapper takes longer for each object than the table's own statement.
        # Not with RETURNING: SQLite would run one statement for each row.
        if rows:
            session.connection().execute(_INSERT_STAGES, rows)
        added = select(StageRow.id).where(StageRow.job_id == job.id, StageRow.name == stage.name).order_by(StageRow.id)
        ids[stage.name] = list(session.scalars(added))
    _report_job(session, job)
    return job


def ready(session: Session, job_id: str) -> list[Claim]:
    """Return the claims that a job's ready stages would give."""
    columns = StageRow.id, StageRow.job_id, StageRow.attempt + 1, StageRow.name, StageRow.subject
    query = select(*columns).where(StageRow.job_id == job_id, StageRow.state == StageState.READY)
    return [Claim(*row) for row in session.execute(query.order_by(StageRow.id))]


def finish_ready(session: Session, job_id: str, results: Sequence[tuple[Claim, StoredResult]]) -> None:
    """End ready stages whose results are stored already."""
    job = _lock(session, job_id)
    # The lock of the job keeps the states until the end of this transaction.
    still_ready = {claim.stage_id for claim in ready(session, job_id)}
    ended = [(claim, result) for claim, result in results if claim.stage_id in still_ready]
    if not ended:
        return
    # One statement for all rows: after a correction nearly every run of a study ends here.
    session.execute(
        update(StageRow),
        [
            {"id": claim.stage_id, "attempt": claim.attempt, "result": result.sha256, **_REUSED}
            for claim, result in ended
        ],
    )
    session.execute(
        insert(Event),
        [
            {
                "job_id": job_id,
                "kind": "stage",
                "data": {"name": claim.name, "subject": claim.subject, "attempt": claim.attempt, **_REUSED},
            }
            for claim, _ in ended
        ],
    )
    for _, result in ended:
        _add_points(session, result)
    _settle(session, job)


def claim(session: Session, stage_id: int, worker: str) -> Claim | None:
    """Claim a ready stage. Return None when the announcement was old or doubled."""
    job_id = session.scalar(select(StageRow.job_id).where(StageRow.id == stage_id, StageRow.state == StageState.READY))
    if job_id is None:
        return None
    job = _lock(session, job_id)
    row = session.execute(
        update(StageRow)
        .where(StageRow.id == stage_id, StageRow.state == StageState.READY)
        .values(
            state=StageState.RUNNING,
            attempt=StageRow.attempt + 1,
            lease_until=db_now() + settings().lease_seconds,
            started=db_now(),
            worker=worker,
            progress=0.0,
        )
        .returning(*_REPORTED)
    ).first()
    if row is None:
        return None
    if job.state == JobState.QUEUED:
        job.state = JobState.RUNNING
        job.started = session.scalar(select(db_now()))
        _report_job(session, job)
    _report_stage(session, job_id, row)
    return Claim(stage_id, job_id, row.attempt, row.name, row.subject)


def beat(session: Session, held: Claim, progress: float) -> Literal["alive", "cancelled", "lost"]:
    """Extend the lease, store the progress, and return whether the work is still wanted."""
    alive = session.execute(
        update(StageRow)
        .where(*_held(held))
        .values(lease_until=db_now() + settings().lease_seconds, progress=progress)
        .returning(*_REPORTED)
    ).first()
    if alive is None:
        return "lost"
    _report_stage(session, held.job_id, alive)
    return "cancelled" if cancel_requested(session, held.job_id) else "alive"


def cancel_requested(session: Session, job_id: str) -> bool:
    """Return whether somebody asked the job to stop."""
    return bool(session.scalar(select(Job.cancel_requested).where(Job.id == job_id)))


def finish(session: Session, held: Claim, result: StoredResult, *, reused: bool) -> bool:
    """Store a stage's end.

    Return False when the claim was lost: then the result is dropped.
    """
    job = _lock(session, held.job_id)
    if not _end(session, held, StageState.DONE, result=result.sha256, reused=reused, progress=1.0):
        return False
    _add_points(session, result)
    _settle(session, job)
    return True


def fail(session: Session, held: Claim, error: dict[str, Any]) -> bool:
    """Store that a stage failed. Return False when the claim was lost."""
    job = _lock(session, held.job_id)
    if not _end(session, held, StageState.FAILED, error=error):
        return False
    _settle(session, job)
    return True


def mend_input(session: Session, held: Claim, sha256: str) -> None:
    """Compute a damaged input of a running stage again, or fail the stage.

    A result of this job becomes ready again, and the stages after it wait for it. A run cannot be computed: the stage
    fails and its error names the remedy.

    Parameters
    ----------
    session : Session
    held : Claim
        The stage that met the damaged file.
    sha256 : str
        Address of the damaged file.
    """
    job = _lock(session, held.job_id)
    rows = _stages(session, job.id)
    own = next(row for row in rows if row.id == held.stage_id)
    broken = [row for row in rows if row.state == StageState.DONE and row.result == sha256]
    # Another stage may have met the same file first: then the input is being computed already.
    inputs = {name for name in STAGES if own.name in after(STAGES[name].name)}
    mending = any(row.name in inputs and row.state not in ENDED_STAGE for row in rows)
    if not (broken or mending) or any(row.attempt >= settings().max_attempts for row in broken):
        _end(session, held, StageState.FAILED, error=_INPUT_BROKEN)
        _settle(session, job)
        return
    if not _end(session, held, StageState.PENDING, progress=0.0):
        return
    now = session.scalar(select(db_now()))
    following = {name for row in broken for name in after(STAGES[row.name].name)}
    for row in rows:
        if row in broken or (row.name in following and row.state in (StageState.DONE, StageState.READY)):
            row.state = StageState.READY if row in broken else StageState.PENDING
            row.result, row.reused, row.progress, row.published, row.publications = None, False, 0.0, None, 0
            row.ready_since = now if row in broken else None
            _report_stage(session, job.id, row)
    if any(row.name == "triangulate" and row.state in (StageState.READY, StageState.PENDING) for row in rows):
        session.execute(delete(Point).where(Point.job_id == job.id))
    session.flush()
    _settle(session, job)


def stopped(session: Session, held: Claim) -> None:
    """Store that a stage stopped because its job was cancelled."""
    job = _lock(session, held.job_id)
    if _end(session, held, StageState.CANCELLED):
        _settle(session, job)


def cancel(session: Session, job_id: str) -> bool:
    """Ask a job to stop. Return False when it had ended.

    Stages that wait are cancelled at once. A running stage stops at its next check.
    """
    job = _lock(session, job_id)
    if job.state in ENDED_JOB:
        return False
    job.cancel_requested = True
    _cancel_waiting(session, job_id, (StageState.PENDING, StageState.READY), STAGES)
    _settle(session, job)
    return True


def give_back(session: Session, held: Claim) -> None:
    """Free a stage whose process has died or must end.

    :func:`reap` does the same after the end of a lease.
    """
    job = _lock(session, held.job_id)
    stage = session.scalar(select(StageRow).where(*_held(held)))
    if stage is not None:
        _free(session, job, stage)


def reap(session: Session) -> int:
    """Free the stages whose workers fell silent and return how many.

    This is the retry after a crash. A stage whose worker crashed becomes ready, so that a worker can try again. It fails after
    its last attempt. It is cancelled when somebody has cancelled the job.
    """
    longest = db_now() + settings().lease_seconds
    # Such a lease was given before the clock was set back. A worker that lives extends it again.
    session.execute(
        update(StageRow)
        .where(StageRow.state == StageState.RUNNING, StageRow.lease_until > longest + CLOCK_TOLERANCE_SECONDS)
        .values(lease_until=longest)
    )
    expired = session.execute(
        select(StageRow.id, StageRow.job_id)
        .where(StageRow.state == StageState.RUNNING, StageRow.lease_until < db_now())
        .order_by(StageRow.job_id, StageRow.id)
    ).all()
    for stage_id, job_id in expired:
        # A transaction that holds the job now renews the lease, or is another reaper. Skip the stage until the next sweep.
        free = session.scalar(select(Job.id).where(Job.id == job_id).with_for_update(skip_locked=True))
        if free is None:
            continue
        job = _lock(session, job_id)
        stage = session.scalar(
            select(StageRow)
            .where(StageRow.id == stage_id, StageRow.state == StageState.RUNNING, StageRow.lease_until < db_now())
            .execution_options(populate_existing=True)
        )
        if stage is not None:
            _free(session, job, stage)
            tally.add(session, {"leases_reaped": 1.0})
    return len(expired)


def _free(session: Session, job: Job, stage: StageRow) -> None:
    """End an attempt that gave no result.

    The stage is ready for another attempt, cancelled, or failed after the last one.
    """
    if job.cancel_requested:
        stage.state = StageState.CANCELLED
    elif stage.attempt >= settings().max_attempts:
        stage.state = StageState.FAILED
        stage.error = {
            "code": "worker_lost",
            "detail": f"This stage began {stage.attempt} times and never ended: the worker died, ran out of memory or could not "
            "store the result. Look at the worker's log, memory and disk, then start a new job.",
        }
    else:
        stage.state = StageState.READY
        stage.ready_since = session.scalar(select(db_now()))
    stage.published, stage.publications, stage.lease_until, stage.worker = None, 0, None, None
    _report_stage(session, job.id, stage)
    _settle(session, job)


def _held(held: Claim) -> tuple[Any, ...]:
    return (
        StageRow.id == held.stage_id,
        StageRow.attempt == held.attempt,
        StageRow.state == StageState.RUNNING,
    )


def _lock(session: Session, job_id: str) -> Job:
    locking = update(Job).where(Job.id == job_id).values(version=Job.version + 1).returning(Job)
    # The snapshot is long and never changes: it stays in the database.
    answer = session.scalars(locking.options(defer(Job.snapshot)), execution_options={"populate_existing": True})
    return answer.one()


def _add_points(session: Session, result: StoredResult) -> None:
    # A study may have a thousand points, and the mapper takes longer for each row than the table's own statement.
    connection = session.connection()
    # Rejected points have fewer columns. One statement serves successive points with the same columns.
    for _, points in itertools.groupby(result.points, key=dict.keys):
        connection.execute(_INSERT_POINTS, list(points))


def _end(session: Session, held: Claim, state: StageState, **values: Any) -> bool:
    ended = session.execute(
        update(StageRow).where(*_held(held)).values(state=state, lease_until=None, **values).returning(*_REPORTED)
    ).first()
    if ended is None:
        return False
    _report_stage(session, held.job_id, ended)
    if state in ENDED_STAGE:
        _count(session, held, state)
    return True


def _count(session: Session, held: Claim, state: StageState) -> None:
    """Add the end of a stage to the sums that the metrics report."""
    started = StageRow.started
    seconds = session.scalar(select(db_now() - started).where(StageRow.id == held.stage_id)) or 0.0
    bucket = next((limit for limit in SECONDS_BUCKETS if seconds <= limit), float("inf"))
    counts = {f"stages|{held.name}|{state}": 1.0}
    if state == StageState.DONE:
        counts |= {f"stage_seconds|{held.name}": max(seconds, 0.0), f"stage_seconds_bucket|{held.name}|{bucket:g}": 1.0}
    tally.add(session, counts)


def _cancel_waiting(session: Session, job_id: str, states: Iterable[StageState], names: Iterable[str]) -> None:
    waiting = session.execute(
        update(StageRow)
        .where(StageRow.job_id == job_id, StageRow.state.in_(list(states)), StageRow.name.in_(list(names)))
        .values(state=StageState.CANCELLED)
        .returning(*_REPORTED)
    ).all()
    for stage in waiting:
        _report_stage(session, job_id, stage)


def _settle(session: Session, job: Job) -> None:
    """Make stages ready whose inputs have ended, and end a finished job.

    The caller holds the lock of the job's row.
    """
    session.flush()
    if not _may_settle(session, job.id):
        return
    rows = _settled_columns(session, job.id)
    broken = _broken(rows)
    if broken:
        job.error = job.error or {"subject": broken[0].name, **(broken[0].error or {})}
        lost = {name for row in broken for name in after(STAGES[row.name].name)}
        _cancel_waiting(session, job.id, (StageState.PENDING,), lost)
        rows = _settled_columns(session, job.id)
    ended = {row.id for row in rows if row.state in ENDED_STAGE}
    now = session.scalar(select(db_now()))
    waiting = [row for row in rows if row.state == StageState.PENDING and ended.issuperset(row.depends_on)]
    if waiting:
        _make_ready(session, job.id, waiting, now)
    if len(ended) == len(rows):
        if job.cancel_requested:
            job.state = JobState.CANCELLED
        else:
            job.state = JobState.FAILED if broken else JobState.SUCCEEDED
        job.finished = now
        tally.add(session, {f"jobs|{job.state}": 1.0})
        _report_job(session, job)


def _settled_columns(session: Session, job_id: str) -> Sequence[Row[*tuple[Any, ...]]]:
    """Return the columns that :func:`_settle` reads of a job's stages.

    A job may have a thousand stages.
    """
    query = select(StageRow.id, StageRow.depends_on, StageRow.error, *_REPORTED).where(StageRow.job_id == job_id)
    return session.execute(query.order_by(StageRow.id)).all()


def _make_ready(session: Session, job_id: str, rows: Sequence[Row[*tuple[Any, ...]]], now: float | None) -> None:
    """Make stages ready, with one statement for all."""
    session.execute(
        update(StageRow)
        .where(StageRow.id.in_([row.id for row in rows]))
        .values(state=StageState.READY, ready_since=now)
        .execution_options(synchronize_session=False)
    )
    events = [{"job_id": job_id, "kind": "stage", "data": _reported(row) | {"state": StageState.READY}} for row in rows]
    session.execute(insert(Event), events)


def _may_settle(session: Session, job_id: str) -> bool:
    """Return whether the states allow a change.

    Stages may become ready, or the job may fail or end. The function reads which states each kind of stage has, so
    that the end of one of a thousand stages does not read the others.
    """
    query = select(StageRow.name, StageRow.state).where(StageRow.job_id == job_id).distinct()
    states: dict[str, set[str]] = {}
    for name, state in session.execute(query):
        states.setdefault(name, set()).add(state)
    ended = {name for name, found in states.items() if found <= ENDED_STAGE}
    return (
        len(ended) == len(states)
        or any(StageState.FAILED in found for found in states.values())
        or any(
            StageState.PENDING in found and ended.issuperset(set(STAGES[name].depends_on) & states.keys())
            for name, found in states.items()
        )
    )


def _broken(rows: Sequence[Row[*tuple[Any, ...]]]) -> list[Row[*tuple[Any, ...]]]:
    """Return the failed stages that fail the job: without their results nothing can follow."""
    failed = [row for row in rows if row.state == StageState.FAILED]
    alive = {row.name for row in rows if row.state != StageState.FAILED}
    return [
        row for row in failed
        if STAGES[row.name].fails == "job" or (row.name not in alive and after(STAGES[row.name].name))
    ]  # fmt: skip


def _stages(session: Session, job_id: str) -> Sequence[StageRow]:
    query = select(StageRow).where(StageRow.job_id == job_id).order_by(StageRow.id)
    return session.scalars(query.execution_options(populate_existing=True)).all()


def _report_job(session: Session, job: Job) -> None:
    session.add(Event(job_id=job.id, kind="job", data={"state": job.state, "error": job.error}))


def _report_stage(session: Session, job_id: str, stage: StageRow | Row[*tuple[Any, ...]]) -> None:
    """Add the event of a stage's new state.

    ``stage`` is its row, or a result with the columns of ``_REPORTED``.
    """
    session.add(Event(job_id=job_id, kind="stage", data=_reported(stage)))


def _reported(stage: StageRow | Row[*tuple[Any, ...]]) -> dict[str, Any]:
    data = {column.key: getattr(stage, column.key) for column in _REPORTED}
    return {**data, "progress": round(float(stage.progress), 3)}
