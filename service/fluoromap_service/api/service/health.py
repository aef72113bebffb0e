"""Whether the service is alive, and whether it can do its work."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import structlog
from fastapi import APIRouter, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import func, select

from fluoromap_service.jobs import queue
from fluoromap_service.settings import settings
from fluoromap_service.store import files
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job, WorkerSeen

router = APIRouter(tags=["service"])

WORKER_SECONDS = 30.0
"""A worker that was silent for longer does not count."""

log = structlog.get_logger(__name__)


class Health(BaseModel):
    status: Literal["alive"] = "alive"


class Check(BaseModel):
    """One thing the service needs."""

    name: Literal["database", "broker", "files", "worker"]
    ok: bool
    detail: str = Field(description="What to do where it is not ok.")


class Readiness(BaseModel):
    model_config = ConfigDict(
        json_schema_extra={"examples": [{"ready": True, "checks": [{"name": "database", "ok": True, "detail": ""}]}]}
    )

    ready: bool
    checks: list[Check]


def _database() -> str:
    with reading() as session:
        session.execute(select(Job.id).limit(1))
    return ""


def _broker() -> str:
    if not settings().eager:
        with queue.celery_app().connection_for_write() as connection:
            connection.ensure_connection(max_retries=1, interval_start=0, timeout=3)
    return ""


def _files() -> str:
    with files.incoming() as path:
        path.write_bytes(b"")
    return ""


def _worker() -> str:
    if settings().eager:
        return ""
    with reading() as session:
        seen = session.scalar(
            select(func.count()).select_from(WorkerSeen).where(WorkerSeen.seen > db_now() - WORKER_SECONDS)
        )
    return "" if seen else "No worker gave a sign of life lately; start one with 'fluoromap worker'."


_CHECKS: dict[Literal["database", "broker", "files", "worker"], tuple[Callable[[], str], str]] = {
    "database": (
        _database,
        "The database does not answer or lacks its tables; check its URL, run 'fluoromap db upgrade'.",
    ),
    "broker": (_broker, "The message broker does not answer; check its URL."),
    "files": (_files, "The files cannot be written; check the data folder's permissions and free space."),
    "worker": (_worker, "Nothing is known of workers while the database does not answer."),
}


@router.get("/v1/health", summary="Alive", response_model=Health)
async def health() -> Health:
    """The process answers, however busy its threads are; open to all."""
    return Health()


@router.get(
    "/v1/ready",
    summary="Ready",
    response_model=Readiness,
    responses={503: {"model": Readiness, "description": "Something is missing; the checks say what."}},
)
def ready(response: Response) -> Readiness:
    """Whether database, broker and files can be used and a worker was seen lately; open to all."""
    checks = []
    for name, (check, failure) in _CHECKS.items():
        try:
            detail = check()
        except Exception as error:
            # Whatever a driver raises means the same here, and may hold an address or a password.
            log.warning("not_ready", check=name, error=type(error).__name__)
            detail = failure
        checks.append(Check(name=name, ok=not detail, detail=detail))
    answer = Readiness(ready=all(check.ok for check in checks), checks=checks)
    if not answer.ready:
        response.status_code = 503
    return answer
