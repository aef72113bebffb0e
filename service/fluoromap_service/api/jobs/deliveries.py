"""The routes of deliveries: the results of jobs on their way to PACS, archives and programs."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from fluoromap_service.api.http.paging import Page, Pages
from fluoromap_service.api.http.paths import DeliveryId, JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.api.http.timestamps import rfc3339, rfc3339_or_none
from fluoromap_service.deliveries import outbox
from fluoromap_service.problem import not_found
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Delivery, DeliveryState, ObjectState

router = APIRouter(tags=["deliveries"])


class DeliveryError(BaseModel):
    """The reason why the last attempt failed."""

    code: str = Field(examples=["unreachable"])
    detail: str = Field(description="What is wrong and what to do.")


class DeliverySummary(BaseModel):
    """One delivery in a list; the delivery itself has its objects and attempts too."""

    id: str
    target: str = Field(description="Name in the file of targets.")
    job: str
    state: DeliveryState
    attempts: int = Field(description="Number of attempts that began.")
    next_attempt: str | None = Field(description="Time of the next attempt while the delivery waits.")
    error: DeliveryError | None
    created: str
    finished: str | None


class DeliveredObject(BaseModel):
    """A DICOM object of a delivery."""

    name: str = Field(examples=["report.dcm"])
    sop_instance_uid: str
    state: ObjectState
    delivered: str | None


class Attempt(BaseModel):
    """An attempt that has ended."""

    number: int
    ended: str
    error: DeliveryError | None = Field(description="null when everything arrived.")


class DeliveryAnswer(DeliverySummary):
    """One delivery of the results of a job to one target."""

    objects: list[DeliveredObject] = Field(description="Empty until the first attempt, and for a webhook.")
    history: list[Attempt]


class DeliveryRequest(BaseModel):
    """The target that a job's results are sent to."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"target": "pacs"}]})

    target: str = Field(description="Name in the file of targets.", max_length=64)


@router.get(
    "/v1/deliveries",
    summary="List deliveries",
    response_model=Page[DeliverySummary],
    responses=responses(400, 401, 403, 422),
)
def list_deliveries(
    caller: Reader,
    pages: Pages,
    job: Annotated[str | None, Query(description="Only the deliveries of this job.")] = None,
    target: Annotated[str | None, Query(description="Only the deliveries to this target.")] = None,
    state: Annotated[DeliveryState | None, Query(description="Only the deliveries in this state.")] = None,
) -> Page[DeliverySummary]:
    """List all deliveries, the newest first."""
    wanted = ((Delivery.job_id, job), (Delivery.target, target), (Delivery.state, state))
    conditions = [column == value for column, value in wanted if value is not None]
    with reading() as session:
        found = pages.newest_first(session, Delivery, *conditions)
    return pages.page_of_newest(found, _summary)


@router.get(
    "/v1/deliveries/{delivery_id}",
    summary="Read a delivery",
    response_model=DeliveryAnswer,
    responses=responses(401, 403, 404),
)
def get_delivery(delivery_id: DeliveryId, caller: Reader) -> DeliveryAnswer:
    """Return the state of a delivery, its objects and the history of its attempts."""
    with reading() as session:
        delivery = session.get(Delivery, delivery_id)
        if delivery is None:
            raise not_found("delivery")
        return _answer(session, delivery)


@router.post(
    "/v1/deliveries/{delivery_id}:retry",
    status_code=202,
    summary="Repeat a delivery",
    response_model=DeliveryAnswer,
    responses=responses(401, 403, 404, 409),
)
def retry_delivery(delivery_id: DeliveryId, caller: Writer) -> DeliveryAnswer:
    """Try a delivery again at once, also one that was given up.

    Objects that have arrived are not sent again.
    """
    with writing() as session:
        return _answer(session, outbox.retry(session, delivery_id))


@router.post(
    "/v1/jobs/{job_id}/deliveries",
    status_code=202,
    summary="Send results",
    response_model=DeliveryAnswer,
    responses=responses(401, 403, 404, 409, 422),
)
def request_delivery(job_id: JobId, body: DeliveryRequest, caller: Writer, response: Response) -> DeliveryAnswer:
    """Send the results of an ended job to a target.

    New jobs are sent by themselves. This is for jobs that ended before the target was configured. A delivery that exists
    is tried again.
    """
    with writing() as session:
        answer = _answer(session, outbox.request(session, job_id, body.target))
    response.headers["Location"] = f"/v1/deliveries/{answer.id}"
    return answer


def _summary(row: Delivery) -> DeliverySummary:
    return DeliverySummary(
        id=row.id,
        target=row.target,
        job=row.job_id,
        state=DeliveryState(row.state),
        attempts=row.attempt,
        next_attempt=rfc3339(row.due) if row.state == DeliveryState.WAITING else None,
        error=None if row.error is None else DeliveryError(**row.error),
        created=rfc3339(row.created),
        finished=rfc3339_or_none(row.finished),
    )


def _answer(session: Session, row: Delivery) -> DeliveryAnswer:
    return DeliveryAnswer(
        **_summary(row).model_dump(),
        objects=[
            DeliveredObject(
                name=item.name,
                sop_instance_uid=item.sop_instance_uid,
                state=ObjectState(item.state),
                delivered=rfc3339_or_none(item.delivered),
            )
            for item in outbox.objects_of(session, row.id)
        ],
        history=[
            Attempt(
                number=attempt.number,
                ended=rfc3339(attempt.ended),
                error=None if attempt.code is None else DeliveryError(code=attempt.code, detail=attempt.detail or ""),
            )
            for attempt in outbox.attempts_of(session, row.id)
        ],
    )
