"""The routes of deliveries: the results of jobs on their way to PACS, archives and programs."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Query, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from fluoromap_service.api.http.idempotency import OnceJson
from fluoromap_service.api.http.paging import NewestFirst, Page, Pages
from fluoromap_service.api.http.paths import DeliveryId, JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.api.http.timestamps import rfc3339, rfc3339_or_none
from fluoromap_service.api.results.result_objects import plan_objects
from fluoromap_service.deliveries import outbox
from fluoromap_service.problem import not_found
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Delivery, DeliveryObject, DeliveryState, ObjectState

router = new_router(tags=["deliveries"])

_DELIVERIES = NewestFirst(Delivery)

State = Literal["pending", "delivered", "failed"]
_STATES: dict[State, tuple[DeliveryState, ...]] = {
    "pending": (DeliveryState.PENDING, DeliveryState.SENDING),
    "delivered": (DeliveryState.DELIVERED,),
    "failed": (DeliveryState.FAILED,),
}
_STATE_OF: dict[str, State] = {str(stored): shown for shown, states in _STATES.items() for stored in states}


class DeliveryError(BaseModel):
    """The reason why an attempt failed."""

    code: str = Field(examples=["unreachable"])
    detail: str = Field(description="What is wrong and what to do.")


class DeliverySummary(BaseModel):
    """One delivery in a list; the delivery itself has its objects and attempts too."""

    id: str
    job: str
    target: str = Field(description="Name in the configuration file.")
    state: State
    attempts: int = Field(description="Number of attempts that began.")
    next_attempt: str | None = Field(description="Time of the next attempt while the delivery is pending.")
    error: DeliveryError | None = Field(description="Of the last attempt.")
    created: str
    finished: str | None


class DeliveredInstance(BaseModel):
    """A DICOM object of a delivery."""

    sop_instance_uid: str
    name: str = Field(examples=["report.dcm"])
    state: State
    attempts: int = Field(description="Number of attempts that had to send it.")
    error: DeliveryError | None
    delivered: str | None


class Attempt(BaseModel):
    """An attempt that has ended."""

    number: int
    ended: str
    error: DeliveryError | None = Field(description="null when everything arrived.")


class DeliveryAnswer(DeliverySummary):
    """The delivery of the results of a job to one target."""

    instances: list[DeliveredInstance] = Field(description="Empty for a webhook.")
    history: list[Attempt]


class DeliveryRequest(BaseModel):
    """The target that a job's results are sent to."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"target": "pacs"}]})

    target: str = Field(description="Name in the configuration file.", max_length=64)


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
    state: Annotated[State | None, Query(description="Only the deliveries in this state.")] = None,
) -> Page[DeliverySummary]:
    """List all deliveries, the newest first."""
    wanted = ((Delivery.job_id, job), (Delivery.target, target))
    conditions = [column == value for column, value in wanted if value is not None]
    if state is not None:
        conditions.append(Delivery.state.in_(_STATES[state]))
    with reading() as session:
        found = pages.newest_first(session, _DELIVERIES, *conditions)
    return pages.page_of_newest(found, _summary)


@router.post(
    "/v1/jobs/{job_id}/deliveries",
    status_code=202,
    summary="Send results",
    response_model=DeliveryAnswer,
    responses={
        202: {
            "description": "Accepted; follow it at Location.",
            "headers": {"Location": {"schema": {"type": "string"}, "description": "The delivery."}},
        },
        **responses(400, 401, 403, 404, 409, 422, 429),
    },
)
def create_delivery(job_id: JobId, body: DeliveryRequest, caller: Writer, once: OnceJson) -> Response:
    """Send the results of an ended job to a target.

    A job has one delivery to each target. One that has failed is tried again. Objects that have arrived are not sent again.
    """
    with reading() as session:
        kind = outbox.target_kind(session, job_id, body.target)
    objects = {} if kind == "webhook" else plan_objects(job_id).names()

    def start(session: Session) -> Response:
        delivery = outbox.request(session, job_id, body.target)
        outbox.add_objects(session, delivery.id, objects)
        answer = _answer(session, delivery).model_dump(mode="json")
        return JSONResponse(answer, 202, {"Location": f"/v1/jobs/{job_id}/deliveries/{delivery.id}"})

    return once.answer(start)


@router.get(
    "/v1/jobs/{job_id}/deliveries/{delivery_id}",
    summary="Read a delivery",
    response_model=DeliveryAnswer,
    responses=responses(401, 403, 404),
)
def get_delivery(job_id: JobId, delivery_id: DeliveryId, caller: Reader) -> DeliveryAnswer:
    """Return the state of a delivery, its objects and the history of its attempts."""
    with reading() as session:
        return _answer(session, _delivery(session, job_id, delivery_id))


@router.post(
    "/v1/jobs/{job_id}/deliveries/{delivery_id}:retry",
    status_code=202,
    summary="Repeat a delivery",
    response_model=DeliveryAnswer,
    responses=responses(401, 403, 404),
)
def retry_delivery(job_id: JobId, delivery_id: DeliveryId, caller: Writer) -> DeliveryAnswer:
    """Try a delivery again at once, also one that was given up.

    Objects that have arrived are not sent again.
    """
    with writing() as session:
        return _answer(session, outbox.retry(session, _delivery(session, job_id, delivery_id).id))


def _delivery(session: Session, job_id: str, delivery_id: str) -> Delivery:
    delivery = session.get(Delivery, delivery_id)
    if delivery is None or delivery.job_id != job_id:
        raise not_found("delivery of this job")
    return delivery


def _summary(row: Delivery) -> DeliverySummary:
    return DeliverySummary(
        id=row.id,
        job=row.job_id,
        target=row.target,
        state=_STATE_OF[row.state],
        attempts=row.attempt,
        next_attempt=rfc3339(row.due) if row.state == DeliveryState.PENDING else None,
        error=None if row.error is None else DeliveryError(**row.error),
        created=rfc3339(row.created),
        finished=rfc3339_or_none(row.finished),
    )


def _answer(session: Session, row: Delivery) -> DeliveryAnswer:
    summary = _summary(row)
    return DeliveryAnswer(
        **summary.model_dump(),
        instances=[_instance(summary, item) for item in outbox.objects_of(session, row.id)],
        history=[
            Attempt(
                number=attempt.number,
                ended=rfc3339(attempt.ended),
                error=None if attempt.code is None else DeliveryError(code=attempt.code, detail=attempt.detail or ""),
            )
            for attempt in outbox.attempts_of(session, row.id)
        ],
    )


def _instance(delivery: DeliverySummary, item: DeliveryObject) -> DeliveredInstance:
    arrived = item.state == ObjectState.DELIVERED
    return DeliveredInstance(
        sop_instance_uid=item.sop_instance_uid,
        name=item.name,
        state="delivered" if arrived else delivery.state,
        attempts=item.attempts,
        error=None if arrived else delivery.error,
        delivered=rfc3339_or_none(item.delivered),
    )
