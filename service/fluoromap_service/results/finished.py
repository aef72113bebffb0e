"""Jobs and their finished stages, with the problem to report when a stage is not finished."""

from __future__ import annotations

import threading
from collections import OrderedDict

from sqlalchemy.orm import Session, defer

from fluoromap_service.jobs.pipeline import StageName
from fluoromap_service.jobs.stage_results import stage_of
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store.models import ENDED_JOB, Job, StageRow, StageState
from fluoromap_service.study.snapshot import Snapshot

RETRY_SECONDS = 2
_REMEMBERED_SNAPSHOTS = 8
_snapshots: OrderedDict[str, Snapshot] = OrderedDict()
_REMEMBERED_SIMULATED = 1024
_simulated: OrderedDict[str, bool] = OrderedDict()
_lock = threading.Lock()


def job_of(session: Session, job_id: str) -> Job:
    """Return the job of an id.

    Raises
    ------
    Problem
        404 when there is none.
    """
    # The snapshot is long, and most requests do not read it.
    job = session.get(Job, job_id, options=[defer(Job.snapshot)])
    if job is None:
        raise not_found("job")
    return job


def ended_job_of(session: Session, job_id: str, result: str) -> Job:
    """Return a job that has ended.

    Parameters
    ----------
    session : Session
    job_id : str
    result : str
        What the caller makes of the job, for the sentence of the problem: "report".

    Raises
    ------
    Problem
        404 when there is no such job; 409 ``not_ready`` while the job runs.
    """
    job = job_of(session, job_id)
    if job.state not in ENDED_JOB:
        raise _not_ready(f"The {result} is available when the job has ended; follow the job and ask again.", wait=True)
    return job


def snapshot_of(job: Job) -> Snapshot:
    """Return the frozen input of a job.

    It never changes, so a process parses those of the last jobs once.
    """
    with _lock:
        known = _snapshots.get(job.id)
    if known is None:
        known = Snapshot.model_validate(job.snapshot)
    with _lock:
        _snapshots[job.id] = known
        _snapshots.move_to_end(job.id)
        while len(_snapshots) > _REMEMBERED_SNAPSHOTS:
            _snapshots.popitem(last=False)
    return known


def is_simulated(job: Job) -> bool:
    """Return whether all runs of a job are simulated.

    The frozen input of a job never changes and is long, so a process looks once.
    """
    with _lock:
        known = _simulated.get(job.id)
    if known is None:
        # Validating the whole snapshot would take longer than everything else in the answer with a map.
        runs = job.snapshot["runs"].values()
        known = bool(runs) and all(run["facts"].get("simulated", False) for run in runs)
        with _lock:
            _simulated[job.id] = known
            while len(_simulated) > _REMEMBERED_SIMULATED:
                _simulated.popitem(last=False)
    return known


def done_stage(session: Session, job: Job, name: StageName, subject: str | None = None) -> StageRow:
    """Return a stage that is done.

    Raises
    ------
    Problem
        409 ``not_ready``; its sentence says whether waiting helps.
    """
    stage = stage_of(session, job.id, name, subject)
    if stage is not None and stage.state == StageState.DONE and stage.result is not None:
        return stage
    raise stage_not_ready(job, name, stage)


def stage_not_ready(job: Job, name: StageName, stage: StageRow | None) -> Problem:
    """Return the 409 for a result whose stage is not done.

    The stage is not done yet, or will never be.
    """
    if stage is not None and stage.state in (StageState.PENDING, StageState.READY, StageState.RUNNING):
        detail = f"The stage '{name}', which makes this result, is not done yet; follow the job and ask again."
        return _not_ready(detail, wait=True)
    if stage is not None and stage.state == StageState.FAILED:
        cause = (stage.error or {}).get("detail", f"The stage '{name}' failed.")
    elif job.error is not None:
        cause = job.error.get("detail", "The job failed.")
    elif job.cancel_requested:
        cause = f"Somebody cancelled the job before its stage '{name}' was done."
    else:
        cause = f"The job has no result of the stage '{name}'."
    return _not_ready(f"{cause} Start a new job to get this result.", wait=False)


def _not_ready(detail: str, *, wait: bool) -> Problem:
    """Return the 409 ``not_ready``; ``Retry-After`` only where waiting helps."""
    headers = {"Retry-After": str(RETRY_SECONDS)} if wait else {}
    return Problem(409, "not_ready", detail, headers=headers)
