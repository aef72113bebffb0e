"""What every reader of results asks first: is there such a job, and is the stage done that this comes from?"""

from __future__ import annotations

from sqlalchemy.orm import Session

from fluoromap_service.jobs.stage_results import MapResult, load, stage_of
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store.models import Job, StageRow, StageState
from fluoromap_service.study.snapshot import Snapshot

RETRY_SECONDS = 2


def job_of(session: Session, job_id: str) -> Job:
    """The job, or 404."""
    job = session.get(Job, job_id)
    if job is None:
        raise not_found("job")
    return job


def snapshot_of(job: Job) -> Snapshot:
    return Snapshot.model_validate(job.snapshot)


def done_stage(session: Session, job: Job, name: str, subject: str | None = None) -> StageRow:
    """The stage when it is done.

    Raises
    ------
    Problem
        409 ``not_ready`` that says whether waiting helps.
    """
    stage = stage_of(session, job.id, name, subject)
    if stage is not None and stage.state == StageState.DONE and stage.result is not None:
        return stage
    raise not_ready(job, name, stage)


def not_ready(job: Job, name: str, stage: StageRow | None) -> Problem:
    """409: the stage that this comes from is not done yet, or never will be."""
    if stage is not None and stage.state in (StageState.PENDING, StageState.READY, StageState.RUNNING):
        wait = f"This comes from the stage '{name}', which is not done yet; follow the job and ask again."
        return Problem(409, "not_ready", wait, headers={"Retry-After": str(RETRY_SECONDS)})
    if stage is not None and stage.state == StageState.FAILED:
        cause = (stage.error or {}).get("detail", f"The stage '{name}' failed.")
    elif job.error is not None:
        cause = job.error.get("detail", "The job failed.")
    elif job.cancel_requested:
        cause = f"The job was cancelled before its stage '{name}' was done."
    else:
        cause = f"The job has no result of the stage '{name}'."
    return Problem(409, "not_ready", f"{cause} Start a new job to get this result.")


def map_of(session: Session, job: Job) -> tuple[MapResult, StageRow]:
    """A job's map, with the stage it comes from.

    Raises
    ------
    Problem
        409 ``not_ready``, or 409 ``no_map`` with the sentence why the sites support none.
    """
    stage = done_stage(session, job, "fuse")
    outcome = load(MapResult, stage)
    if outcome.chamber is None:
        reasons = {"reasons": [str(outcome.refused)]} if outcome.refused else {}
        raise Problem(409, "no_map", outcome.message or "No map could be made of this study's sites.", extra=reasons)
    return outcome, stage
