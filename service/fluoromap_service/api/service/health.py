"""The routes that say whether the service is alive, and whether it can work."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import structlog
from fastapi import Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import select

from fluoromap_service.api.http.routers import new_router
from fluoromap_service.jobs import living_workers, queue
from fluoromap_service.jobs.stall import StallWatch, stall_seconds
from fluoromap_service.settings import settings
from fluoromap_service.store import disk, files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job

router = new_router(tags=["service"])

_stall = StallWatch()

log = structlog.get_logger(__name__)


CheckName = Literal["database", "broker", "files", "worker", "queue"]


class Health(BaseModel):
    """The sign that the process answers."""

    status: Literal["alive"] = "alive"


class Check(BaseModel):
    """One part that the service needs."""

    name: CheckName
    ok: bool
    detail: str = Field(description="The next step when it is not ok.")


class Readiness(BaseModel):
    """The state of all parts that the service needs."""

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
    if disk.free_bytes() < disk.reserve_bytes():
        return "The disk is nearly full, so uploads are refused; delete studies or give the service more space."
    return ""


def _worker() -> str:
    if settings().eager:
        return ""
    with reading() as session:
        alive = living_workers.living_workers(session)
    return "" if alive else "No worker gave a sign of life in the last 30 s; start one with 'fluoromap worker'."


def watch_queue() -> bool:
    """Look at the queue, and return whether stages wait that nobody runs.

    The service calls it every second, so that the answer does not depend on how often somebody asks.
    """
    with reading() as session:
        return _stall.look(session)


def _queue() -> str:
    if settings().eager or not watch_queue():
        return ""
    return f"Stages are ready, and for {stall_seconds():.0f} s no stage began or ran; start the workers again."


_CHECKS: dict[CheckName, tuple[Callable[[], str], str]] = {
    "database": (
        _database,
        "The database does not answer or lacks its tables; check its URL, run 'fluoromap db upgrade'.",
    ),
    "broker": (_broker, "The message broker does not answer; check its URL."),
    "files": (_files, "The files cannot be written; check the data folder's permissions and free space."),
    "worker": (_worker, "The state of the workers is unknown while the database does not answer; see its check."),
    "queue": (_queue, "The state of the queue is unknown while the database does not answer; see its check."),
}


@router.get("/v1/health", summary="Alive", response_model=Health)
async def health() -> Health:
    """Answer as long as the process lives; open to all.

    It answers also when all threads are busy.
    """
    return Health()


@router.get(
    "/v1/ready",
    summary="Ready",
    response_model=Readiness,
    responses={503: {"model": Readiness, "description": "A part is missing; the checks name it."}},
)
def ready(response: Response) -> Readiness:
    """Report whether database, broker, files, a worker and the queue are ready.

    It is open to all.
    """
    checks = []
    for name, (check, failure) in _CHECKS.items():
        try:
            detail = check()
        except Exception as error:
            # Every error means the same here, and its text may contain an address or a password.
            log.warning("not_ready", check=name, error=type(error).__name__)
            detail = failure
        checks.append(Check(name=name, ok=not detail, detail=detail))
    answer = Readiness(ready=all(check.ok for check in checks), checks=checks)
    if not answer.ready:
        response.status_code = 503
    return answer
