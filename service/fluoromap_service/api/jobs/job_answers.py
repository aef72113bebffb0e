"""Jobs in the shape of the answers."""

from __future__ import annotations

from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Row, bindparam, case, func, select
from sqlalchemy.orm import Session

from fluoromap.reasons import Reason
from fluoromap_service.api.http.problems import ProblemDocument
from fluoromap_service.api.http.timestamps import rfc3339, rfc3339_or_none
from fluoromap_service.jobs.pipeline import StageName
from fluoromap_service.jobs.stage_results import stages_of
from fluoromap_service.results.row_order import warnings_of
from fluoromap_service.store.models import ENDED_JOB, ENDED_STAGE, Event, Job, JobState, StageRow, StageState

_STATUS = HTTPStatus.INTERNAL_SERVER_ERROR
"""Status of every stage's error. The plugin, the worker or the service caused it: data that a plugin refuses fail no stage."""


class StageAnswer(BaseModel):
    """One stage of a job, for one run, one site or the study."""

    name: StageName
    subject: str = Field(description="SOP Instance UID, site or study of the stage.")
    plugin: str
    version: str
    state: StageState
    attempt: int = Field(description="Number of times that the stage began; more than 1 after a worker died.")
    progress: float = Field(ge=0, le=1)
    reused: bool = Field(description="Whether the result comes from an earlier job with the same inputs.")
    error: ProblemDocument | None


class Links(BaseModel):
    """Addresses of the results; each is available as soon as its stage is done."""

    points: str
    tracks: str
    map: str
    overlays: str
    report: str


class JobSummary(BaseModel):
    """One job in a list; the job itself has its stages and warnings too."""

    id: str
    study: str
    state: JobState
    progress: float = Field(ge=0, le=1, description="Mean over the stages; 1 when the job has ended.")
    error: ProblemDocument | None
    created: str
    started: str | None
    finished: str | None
    links: Links


class JobAnswer(BaseModel):
    """One run of the pipeline over a study."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": "7f0c5b1e9a3d4c27b4a1f1f5d6e7a809", "study": "0d9e8f7a6b5c4d3e2f1a0b9c8d7e6f5a", "state": "running",
                    "progress": 0.43,
                    "stages": [
                        {
                            "name": "segment", "subject": "1.2.826.0.1.3680043.8.498.1", "plugin": "four-step",
                            "version": "1", "state": "done", "attempt": 1, "progress": 1.0, "reused": False, "error": None,
                        }
                    ],
                    "error": None, "warnings": [], "created": "2026-03-01T09:30:00.000Z", "started": "2026-03-01T09:30:00.210Z",
                    "finished": None,
                    "links": {
                        "points": "/v1/jobs/7f0c5b1e9a3d4c27b4a1f1f5d6e7a809/points",
                        "tracks": "/v1/jobs/7f0c5b1e9a3d4c27b4a1f1f5d6e7a809/tracks",
                        "map": "/v1/jobs/7f0c5b1e9a3d4c27b4a1f1f5d6e7a809/map",
                        "overlays": "/v1/jobs/7f0c5b1e9a3d4c27b4a1f1f5d6e7a809/overlays",
                        "report": "/v1/jobs/7f0c5b1e9a3d4c27b4a1f1f5d6e7a809/report.html",
                    },
                }
            ]
        }
    )  # fmt: skip

    id: str
    study: str
    state: JobState
    progress: float = Field(ge=0, le=1, description="Mean over the stages; 1 when the job has ended.")
    stages: list[StageAnswer]
    error: ProblemDocument | None
    warnings: list[Reason] = Field(description="Doubts about all results: paired_by_order until it is confirmed.")
    created: str
    started: str | None
    finished: str | None
    links: Links


def job_answer(job: Job, stages: Sequence[StageRow], warnings: Sequence[Reason] = ()) -> JobAnswer:
    """Return a job with its stages in the shape of the answer."""
    return JobAnswer(
        id=job.id,
        study=job.study_id,
        state=JobState(job.state),
        progress=_progress(job, stages),
        stages=[_stage(row) for row in stages],
        error=_problem(job.error),
        warnings=list(warnings),
        created=rfc3339(job.created),
        started=rfc3339_or_none(job.started),
        finished=rfc3339_or_none(job.finished),
        links=_links(job.id),
    )


def read_job(session: Session, job: Job) -> JobAnswer:
    """Return the answer of one job."""
    return job_answer(job, stages_of(session, job.id), warnings_of(session, job))


SUMMARY_COLUMNS = (Job.id, Job.study_id, Job.state, Job.error, Job.created, Job.started, Job.finished)
"""Columns that the entry of a job in a list shows. A snapshot has hundreds of kilobytes."""

_PROGRESS_PART = case((StageRow.state.in_(list(ENDED_STAGE)), 1.0), else_=StageRow.progress)
_PROGRESS = (
    select(StageRow.job_id, func.avg(_PROGRESS_PART))
    .where(StageRow.job_id.in_(bindparam("jobs", expanding=True)))
    .group_by(StageRow.job_id)
)


def job_summaries(session: Session, jobs: Sequence[Row[*tuple[Any, ...]]]) -> dict[str, JobSummary]:
    """Return the entries of several jobs in a list, by their ids.

    The database computes the progress of the running jobs; no stage of a queued job has begun. No stage and no snapshot is read.

    Parameters
    ----------
    session : Session
    jobs : sequence of Row
        With :data:`SUMMARY_COLUMNS`.
    """
    progress = {job.id: 0.0 for job in jobs if job.state == JobState.QUEUED}
    active = [job.id for job in jobs if job.state == JobState.RUNNING]
    if active:
        progress |= {job_id: round(mean, 4) for job_id, mean in session.execute(_PROGRESS, {"jobs": active})}
    return {
        job.id: JobSummary(
            id=job.id,
            study=job.study_id,
            state=JobState(job.state),
            progress=progress.get(job.id, 1.0),
            error=_problem(job.error),
            created=rfc3339(job.created),
            started=rfc3339_or_none(job.started),
            finished=rfc3339_or_none(job.finished),
            links=_links(job.id),
        )
        for job in jobs
    }


def _links(job_id: str) -> Links:
    root = f"/v1/jobs/{job_id}"
    return Links(
        points=f"{root}/points",
        tracks=f"{root}/tracks",
        map=f"{root}/map",
        overlays=f"{root}/overlays",
        report=f"{root}/report.html",
    )


def etag_of(session: Session, job: Job) -> str:
    """Return the job's entity tag.

    It changes with every event and every change of the job.
    """
    last = session.scalar(select(func.max(Event.id)).where(Event.job_id == job.id))
    return f'"{job.id}-{job.version}-{last or 0}-{len(warnings_of(session, job))}"'


def _progress(job: Job, stages: Sequence[StageRow]) -> float:
    if job.state in ENDED_JOB or not stages:
        return 1.0
    parts = [1.0 if row.state in ENDED_STAGE else row.progress for row in stages]
    return round(sum(parts) / len(parts), 4)


def _stage(row: StageRow) -> StageAnswer:
    return StageAnswer.model_validate(
        {
            "name": row.name,
            "subject": row.subject,
            "plugin": row.plugin,
            "version": row.plugin_version,
            "state": row.state,
            "attempt": row.attempt,
            "progress": round(row.progress, 3),
            "reused": row.reused,
            "error": _problem(row.error),
        }
    )


def _problem(error: dict[str, Any] | None) -> ProblemDocument | None:
    """Return the stored error of a stage or job as a problem document."""
    if error is None:
        return None
    code = str(error.get("code", "plugin_failed"))
    detail = str(error.get("detail", "The stage failed."))
    return ProblemDocument(type="about:blank", title=_STATUS.phrase, status=_STATUS, detail=detail, code=code)
