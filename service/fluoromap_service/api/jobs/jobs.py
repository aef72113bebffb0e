"""The routes of jobs: start, list, read and stop them."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Annotated, Literal

from fastapi import Query, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from fluoromap_service.api.http.etags import is_known, not_modified
from fluoromap_service.api.http.idempotency import OnceJson
from fluoromap_service.api.http.paging import NewestFirst, Page, Pages
from fluoromap_service.api.http.paths import JobId, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.api.jobs.job_answers import (
    SUMMARY_COLUMNS,
    JobAnswer,
    JobSummary,
    etag_of,
    job_summaries,
    read_job,
)
from fluoromap_service.api.jobs.job_watch import JobWatch
from fluoromap_service.jobs import job_life, queue
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.results.finished import job_of
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import ENDED_JOB, Job, Study
from fluoromap_service.study.freeze import PipelineRequest, freeze

router = new_router(tags=["jobs"])

_JOBS = NewestFirst(Job, *SUMMARY_COLUMNS)

RETRY_SECONDS = 2


class JobRequest(BaseModel):
    """The plugins and views of a new job."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [{"pipeline": {"triangulator": {"name": "linear", "params": {}}}, "view": "both"}]
        },
    )

    pipeline: PipelineRequest = Field(
        default_factory=PipelineRequest, description="The plugins of the job; every stage has a default plugin."
    )
    view: Literal["a", "b", "both"] = Field("both", description="The views that the job tracks frame by frame.")


@router.post(
    "/v1/studies/{study_id}/jobs",
    status_code=202,
    summary="Start a job",
    response_model=JobAnswer,
    responses={
        202: {
            "description": "Accepted; follow it at Location.",
            "headers": {
                "Location": {"schema": {"type": "string"}, "description": "The job."},
                "Retry-After": {
                    "schema": {"type": "integer"},
                    "description": "Seconds to wait before the next request.",
                },
            },
        },
        **responses(400, 401, 403, 404, 422),
    },
)
def create_job(
    study_id: StudyId,
    caller: Writer,
    once: OnceJson,
    # Not "or None" in the schema: generated clients cannot leave out a body that may be null.
    body: JobRequest = JobRequest(),
) -> Response:
    """Freeze the study and run the pipeline over it.

    The job reuses the results of earlier jobs. At least one site needs both views, their geometry and an activation
    time. Otherwise 422 lists the missing values of each site.
    """

    def start(session: Session) -> Response:
        study = session.get(Study, study_id)
        if study is None:
            raise not_found("study")
        snapshot = freeze(session, study, body.pipeline, body.view)
        job = job_life.create(session, study.id, snapshot)
        session.flush()
        answer = read_job(session, job)
        headers = {"Location": f"/v1/jobs/{job.id}", "Retry-After": str(RETRY_SECONDS)}
        return JSONResponse(answer.model_dump(mode="json"), 202, headers)

    response = once.answer(start)
    queue.publish_due()
    return response


@router.get(
    "/v1/jobs", summary="List jobs", response_model=Page[JobSummary], responses=responses(400, 401, 403, 422)
)  # fmt: skip
def list_jobs(
    caller: Reader, pages: Pages, study: Annotated[str | None, Query(description="Only the jobs of this study.")] = None
) -> Page[JobSummary]:
    """List all jobs, the newest first, without their stages and warnings."""
    with reading() as session:
        found = pages.newest_first(session, _JOBS, *([] if study is None else [Job.study_id == study]))
        answers = job_summaries(session, found)
    return pages.page_of_newest(found, lambda job: answers[job.id])


@router.get(
    "/v1/jobs/{job_id}",
    summary="Read a job",
    response_model=JobAnswer,
    responses={304: {"description": "Unchanged since the ETag sent."}, **responses(401, 403, 404, 422)},
)
async def get_job(
    job_id: JobId,
    request: Request,
    response: Response,
    caller: Reader,
    wait: Annotated[float, Query(ge=0, le=60, description="Longest time to wait for a change, in seconds.")] = 0.0,
) -> JobAnswer | Response:
    """Return state, progress, stages and links of a job.

    With `wait` the answer comes when the job's state changes, when the job has ended, or when the time is over. With `wait` and
    `If-None-Match` it comes at any change of the job.
    """
    if wait > 0:
        first_state, etag = await run_in_threadpool(_state, job_id)
        conditional = "if-none-match" in request.headers
        if first_state not in ENDED_JOB and (not conditional or is_known(request, etag)):
            watch: JobWatch = request.app.state.job_watch
            with suppress(TimeoutError), watch.following(job_id) as follower:
                async with asyncio.timeout(wait):
                    while (news := await follower.next()) is not None and not news.last:
                        if (not is_known(request, news.etag)) if conditional else (news.state != first_state):
                            break
    answer, etag = await run_in_threadpool(_answer, job_id)
    if is_known(request, etag):
        return not_modified(etag)
    response.headers["ETag"] = etag
    response.headers["Cache-Control"] = "private, no-cache"
    return answer


@router.post(
    "/v1/jobs/{job_id}:cancel",
    status_code=202,
    summary="Stop a job",
    response_model=JobAnswer,
    responses=responses(401, 403, 404, 409),
)
def cancel_job(job_id: JobId, caller: Writer) -> JobAnswer:
    """Stop a job.

    Stages that have not begun do not begin; a stage that runs stops at its next check. Finished results stay readable.
    """
    with writing() as session:
        job = job_of(session, job_id)
        if not job_life.cancel(session, job.id):
            raise Problem(
                409, "job_ended", f"This job has ended already: it {_ENDS[job.state]}. Start a new job instead."
            )
        session.flush()
        return read_job(session, job)


_ENDS = {"succeeded": "succeeded", "failed": "failed", "cancelled": "was cancelled"}


def _state(job_id: str) -> tuple[str, str]:
    with reading() as session:
        job = job_of(session, job_id)
        return job.state, etag_of(session, job)


def _answer(job_id: str) -> tuple[JobAnswer, str]:
    with reading() as session:
        job = job_of(session, job_id)
        etag = etag_of(session, job)
        return read_job(session, job), etag
