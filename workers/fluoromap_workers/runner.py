"""One stage from claim to finish."""

from __future__ import annotations

from typing import Any

import structlog
from sqlalchemy.exc import OperationalError
from structlog.typing import FilteringBoundLogger as BoundLogger

from fluoromap.contracts import StageStopped
from fluoromap_service.jobs import job_life
from fluoromap_service.jobs.stage_results import remember
from fluoromap_service.store import files
from fluoromap_service.store.codec import decode, encode
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import File, Job, StageResult
from fluoromap_service.study.snapshot import Snapshot
from fluoromap_workers.heartbeat import Heartbeat
from fluoromap_workers.stage_inputs import Work, prepare

LONGEST_MESSAGE = 500


class PluginFailed(Exception):
    """The plugin raised; the message is what the job's reader is told."""


log = structlog.get_logger(__name__)


def run(stage_id: int, worker: str) -> str | None:
    """Claim a stage, run its plugin, store the result; returns its job, or None when the claim is not to be had."""
    with writing() as session:
        held = job_life.claim(session, stage_id, worker)
    if held is None:
        return None
    bound = log.bind(job=held.job_id, stage=held.name, attempt=held.attempt)
    bound.info("stage_started")
    with Heartbeat(held) as heartbeat:
        try:
            _run(held, heartbeat, bound)
        except StageStopped:
            if heartbeat.cancelled:
                with writing() as session:
                    job_life.stopped(session, held)
            bound.info("stage_stopped")
        except (OperationalError, OSError) as error:
            # The machine's fault, not the plugin's: the lease runs out and the stage is tried again.
            bound.warning("stage_interrupted", error=type(error).__name__)
        except PluginFailed as failure:
            bound.warning("stage_failed", exc_info=failure.__cause__)
            with writing() as session:
                job_life.fail(session, held, {"code": "plugin_failed", "detail": str(failure)})
        except Exception as error:
            bound.error("stage_broken", error=type(error).__name__, exc_info=error)
            detail = "The service could not prepare or store this stage's work; its log tells more."
            with writing() as session:
                job_life.fail(session, held, {"code": "internal", "detail": detail})
    return held.job_id


def finish_known(job_id: str) -> None:
    """End at once what is ready of a job and was computed before: after a correction nearly all of its runs."""
    try:
        with reading() as session:
            ready = job_life.ready(session, job_id)
        works = [(stage.stage_id, _prepare(stage)) for stage in ready]
        kept = [(stage_id, _kept_result(work.key)) for stage_id, work in works if work.rows is None]
        known = {stage_id: sha256 for stage_id, sha256 in kept if sha256 is not None}
        if known:
            with writing() as session:
                files.lock(session)
                # Nobody can remove them from here on; what was removed a moment ago is computed again.
                stored = {stage_id: sha256 for stage_id, sha256 in known.items() if session.get(File, sha256)}
                job_life.finish_ready(session, job_id, stored)
    except Exception as error:
        # Each stage says for itself what is wrong with it when its turn comes.
        log.warning("nothing_finished_at_once", job=job_id, error=type(error).__name__)


def _run(held: job_life.Claim, heartbeat: Heartbeat, bound: BoundLogger) -> None:
    work = _prepare(held)
    kept = _kept_result(work.key)
    if kept:
        content = files.path_of(kept).read_bytes()
        result = decode(work.kind, content) if work.rows else None
    else:
        result, content = _computed(held, work, heartbeat)
    rows = list(work.rows(result)) if work.rows else []
    heartbeat.check()
    # Kept again even when it was kept before: then nobody can have removed it since.
    with files.incoming() as path, writing() as session:
        path.write_bytes(content)
        sha256 = files.keep(session, path, "application/json")
        if session.get(StageResult, work.key) is None:
            session.add(StageResult(key=work.key, sha256=sha256))
        if not job_life.finish(session, held, sha256, reused=kept is not None, rows=rows):
            raise StageStopped("the claim was lost while the result was stored")
    if result is not None:
        remember(sha256, result, len(content))
    bound.info("stage_done", reused=kept is not None)


def _computed(held: job_life.Claim, work: Work, heartbeat: Heartbeat) -> tuple[Any, bytes]:
    try:
        result = work.compute(heartbeat)
        return result, encode(result)
    except StageStopped:
        raise
    except Exception as error:
        message = " ".join(str(error).split()) or "no message"
        sentence = f"The stage {held.name!r} failed: {type(error).__name__}: {message}"
        raise PluginFailed(sentence[:LONGEST_MESSAGE]) from error


def _prepare(held: job_life.Claim) -> Work:
    with reading() as session:
        job = session.get_one(Job, held.job_id)
        return prepare(session, held, Snapshot.model_validate(job.snapshot))


def _kept_result(key: str) -> str | None:
    with reading() as session:
        kept = session.get(StageResult, key)
        return kept.sha256 if kept is not None and files.path_of(kept.sha256).exists() else None
