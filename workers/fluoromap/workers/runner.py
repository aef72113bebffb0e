"""One stage from claim to finish."""

from __future__ import annotations

import structlog

from fluoromap.contracts import StageStopped
from fluoromap.store import files, jobs
from fluoromap.store.engine import reading, writing
from fluoromap.store.manifest import Manifest
from fluoromap.store.models import Job, StageResult
from fluoromap.workers.bridge import Work, prepare
from fluoromap.workers.heartbeat import Heartbeat

LONGEST_MESSAGE = 500

log = structlog.get_logger(__name__)


def run(stage_id: int, worker: str) -> None:
    """Claim a stage, run its plugin, store the result; do nothing when the claim is not to be had."""
    with writing() as session:
        held = jobs.claim(session, stage_id, worker)
    if held is None:
        return
    bound = log.bind(job=held.job_id, stage=held.name, attempt=held.attempt)
    bound.info("stage_started")
    with Heartbeat(held) as heartbeat:
        try:
            work = _prepare(held)
            kept = _kept_result(work.key)
            content = None if kept else work.compute(heartbeat)
            heartbeat.check()
        except StageStopped:
            if heartbeat.cancelled:
                with writing() as session:
                    jobs.stopped(session, held)
            bound.info("stage_stopped")
            return
        except Exception as error:
            bound.warning("stage_failed", error=type(error).__name__, exc_info=error)
            with writing() as session:
                jobs.fail(session, held, {"code": "plugin_failed", "detail": _sentence(held, error)})
            return
    with files.incoming() as path:
        if content is not None:
            path.write_bytes(content)
        with writing() as session:
            if kept is None:
                sha256 = files.keep(session, path, "application/json")
                if session.get(StageResult, work.key) is None:
                    session.add(StageResult(key=work.key, sha256=sha256))
            else:
                sha256 = kept
            rows = work.rows(files.path_of(sha256).read_bytes())
            if not jobs.finish(session, held, sha256, reused=kept is not None, rows=rows):
                bound.info("stage_came_late")
                return
    bound.info("stage_done", reused=kept is not None)


def _prepare(held: jobs.Claim) -> Work:
    with reading() as session:
        job = session.get_one(Job, held.job_id)
        return prepare(session, held, Manifest.model_validate(job.manifest))


def _kept_result(key: str) -> str | None:
    with reading() as session:
        kept = session.get(StageResult, key)
        return kept.sha256 if kept is not None and files.path_of(kept.sha256).exists() else None


def _sentence(held: jobs.Claim, error: Exception) -> str:
    message = " ".join(str(error).split()) or type(error).__name__
    return f"The stage {held.name!r} failed: {type(error).__name__}: {message}"[:LONGEST_MESSAGE]
