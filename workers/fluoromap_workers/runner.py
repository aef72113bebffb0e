"""One stage from claim to finish."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import structlog
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session
from structlog.typing import FilteringBoundLogger as BoundLogger

from fluoromap.contracts import Refusal, StageStopped
from fluoromap_service.jobs import job_life
from fluoromap_service.jobs.job_life import Claim, StoredResult
from fluoromap_service.jobs.stage_results import load_file, remember
from fluoromap_service.store import files
from fluoromap_service.store.codec import encode
from fluoromap_service.store.engine import DATABASE_AWAY, reading, writing
from fluoromap_service.store.files import BrokenFile
from fluoromap_service.store.models import File, Job, StageResult
from fluoromap_service.study.snapshot import Snapshot
from fluoromap_workers.heartbeat import Heartbeat
from fluoromap_workers.partial_results import Connection, StageContext
from fluoromap_workers.stage_inputs import PluginChanged, StoredJob, Work, prepare

LONGEST_MESSAGE = 500


class PluginFailed(Exception):
    """The plugin raised, or another version of it is installed.

    ``error`` is the error of the stage, with its code. It reaches the reader of the job.
    """

    def __init__(self, error: dict[str, str]) -> None:
        super().__init__(error["detail"])
        self.error = error


log = structlog.get_logger(__name__)


Announce = Callable[[], None]


class Place(Protocol):
    """A process in which stages run."""

    def is_ready(self) -> bool:
        """Return whether a stage may be claimed for this place."""

    def run(self, held: Claim, announce: Announce) -> None:
        """Run a claimed stage until it has ended or waits for another attempt.

        ``announce`` announces the other stages that are ready. It is called once, while the stage runs where that is possible.
        """

    def finish_known(self, job_id: str) -> None:
        """End all ready stages of a job whose results are stored."""


class ThisProcess:
    """The calling process as a place for stages: jobs that run at once, and tests."""

    def is_ready(self) -> bool:
        return True

    def run(self, held: Claim, announce: Announce) -> None:
        with Heartbeat(held) as heartbeat:
            work(held, heartbeat)
            if heartbeat.cancelled:
                with writing() as session:
                    job_life.stopped(session, held)
        announce()

    def finish_known(self, job_id: str) -> None:
        finish_known(job_id)


THIS_PROCESS = ThisProcess()


def run(stage_id: int, worker: str, place: Place = THIS_PROCESS, announce: Announce = lambda: None) -> None:
    """Claim a stage for a worker, run its plugin and store the result.

    Do nothing when another worker was faster. For ``announce`` see :class:`Place`.
    """
    with writing() as session:
        held = job_life.claim(session, stage_id, worker)
    if held is not None:
        place.run(held, announce)


def work(held: Claim, connection: Connection) -> None:
    """Run a claimed stage and store its end.

    A stage that stops because nobody wants it stays claimed.
    """
    bound = log.bind(job=held.job_id, stage=held.name, attempt=held.attempt)
    bound.info("stage_started")
    try:
        _run(held, connection, bound)
    except StageStopped:
        bound.info("stage_stopped")
    except (*DATABASE_AWAY, OSError) as error:
        # The machine failed, not the plugin: the lease runs out and another attempt follows.
        bound.warning("stage_interrupted", error=type(error).__name__)
    except BrokenFile as broken:
        bound.error("broken_file", sha256=broken.sha256)
        with writing() as session:
            job_life.mend_input(session, held, broken.sha256)
    except PluginFailed as failure:
        bound.warning("stage_failed", exc_info=failure.__cause__)
        _fail(held, failure.error, bound)
    except Exception as error:
        bound.error("stage_broken", error=type(error).__name__, exc_info=error)
        detail = "The service could not prepare or store the work of this stage. Look at the worker's log."
        _fail(held, {"code": "internal", "detail": detail}, bound)


def _fail(held: Claim, error: dict[str, str], bound: BoundLogger) -> None:
    try:
        with writing() as session:
            job_life.fail(session, held, error)
    except SQLAlchemyError as away:
        # The lease runs out, and another attempt fails in the same way.
        bound.warning("failure_not_stored", error=type(away).__name__)


def finish_known(job_id: str) -> None:
    """End all ready stages of a job whose results are stored.

    After a correction these are nearly all of its runs.
    """
    try:
        with reading() as session:
            works = [(claim, _prepare(session, claim)) for claim in job_life.ready(session, job_id)]
            stored = _addresses(session, [work.key for _, work in works])
        known = [
            (claim, _with_points(work, stored[work.key]))
            for claim, work in works
            if work.key in stored and files.is_whole(stored[work.key])
        ]
        if known:
            with writing() as session:
                held = _held_files(session, [result.sha256 for _, result in known])
                job_life.finish_ready(session, job_id, [entry for entry in known if entry[1].sha256 in held])
    except Exception as error:
        # A stage that cannot be prepared fails with its own reason when its turn comes.
        log.warning("nothing_finished_at_once", job=job_id, error=type(error).__name__)


def _run(held: Claim, connection: Connection, bound: BoundLogger) -> None:
    with reading() as session:
        work = _prepare(session, held)
        stored = _stored(session, work)
    if stored is not None:
        with writing() as session:
            kept = _held_files(session, [stored.sha256])
            taken = bool(kept) and job_life.finish(session, held, stored, reused=True)
        if taken:
            bound.info("stage_done", reused=True)
            return
    result, content = _computed(held, work, StageContext(connection, held, work.plugin()))
    points = tuple(work.points(result)) if work.points else ()
    connection.check()
    sha256 = hashlib.sha256(content).hexdigest()
    with files.incoming() as path:
        path.write_bytes(content)
        with writing() as session:
            files.keep(session, path, sha256=sha256)
            session.merge(StageResult(key=work.key, sha256=sha256))
            if not job_life.finish(session, held, StoredResult(sha256, points), reused=False):
                raise StageStopped("the claim was lost while the result was stored")
    remember(sha256, result, len(content))
    bound.info("stage_done", reused=False)


def _computed(held: Claim, work: Work, context: StageContext) -> tuple[Any, bytes]:
    try:
        try:
            result = work.compute(context)
        except Refusal as refusal:
            result = work.refused(refusal)
        return result, encode(result, context.partial)
    except (StageStopped, BrokenFile):
        raise
    except PluginChanged as error:
        raise PluginFailed({"code": "plugin_changed", "detail": str(error)}) from error
    except Exception as error:
        message = " ".join(str(error).split()) or "no message"
        sentence = f"The stage {held.name!r} failed: {type(error).__name__}: {message}"
        raise PluginFailed({"code": "plugin_failed", "detail": sentence[:LONGEST_MESSAGE]}) from error


def _prepare(session: Session, claim: Claim) -> Work:
    # The stages of a job share its rows, as far as one transaction reads them.
    jobs: dict[str, StoredJob] = session.info.setdefault("jobs", {})
    if claim.job_id not in jobs:
        jobs[claim.job_id] = StoredJob(session, claim.job_id, _snapshot(claim.job_id))
    return prepare(jobs[claim.job_id], claim)


@functools.lru_cache(maxsize=8)
def _snapshot(job_id: str) -> Snapshot:
    """Return a job's snapshot, parsed once.

    It never changes, and a worker takes many stages of the same few jobs.
    """
    with reading() as session:
        return Snapshot.model_validate(session.get_one(Job, job_id).snapshot)


def _stored(session: Session, work: Work) -> StoredResult | None:
    """Return the result that an earlier job stored for the same work."""
    sha256 = _addresses(session, [work.key]).get(work.key)
    return None if sha256 is None or not files.is_whole(sha256) else _with_points(work, sha256)


def _addresses(session: Session, keys: Sequence[str]) -> dict[str, str]:
    """Return the addresses of the results that are stored under these keys."""
    query = select(StageResult.key, StageResult.sha256).where(StageResult.key.in_(keys))
    return {row.key: row.sha256 for row in session.execute(query)}


def _with_points(work: Work, sha256: str) -> StoredResult:
    return StoredResult(sha256, tuple(work.points(load_file(work.kind, sha256))) if work.points else ())


def _held_files(session: Session, addresses: Sequence[str]) -> set[str]:
    """Return those of the results that the store still holds.

    Nobody can remove them until this transaction ends.
    """
    files.lock(session)
    return set(session.scalars(select(File.sha256).where(File.sha256.in_(addresses))))
