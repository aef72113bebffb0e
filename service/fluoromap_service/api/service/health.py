"""The routes that say whether the service is alive, and whether it can work."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Literal

import structlog
from fastapi import Request, Response
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

ANSWER_SECONDS = 1.0
"""Age up to which all callers get the same answer."""
CHECK_SECONDS = 1.0
"""Longest time that an answer waits for its checks; a check that takes longer has failed."""

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


class ReadinessWatch:
    """The readiness of this process, found by one thread at most once a second, whatever the number of callers.

    A check that hangs goes on in its own thread and is not started again before it ends. So a part that is silent costs one
    thread, and no caller waits for it longer than ``CHECK_SECONDS``.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "readiness")
        self._lock = threading.Lock()
        self._answer: Future[Readiness] | None = None
        self._ended = 0.0
        self._running: dict[CheckName, Future[str]] = {}

    def answer(self) -> Future[Readiness]:
        """Return the answer of this moment, which may still be on its way."""
        with self._lock:
            known = self._answer
            if known is None or (known.done() and time.monotonic() - self._ended >= ANSWER_SECONDS):
                self._answer = known = self._thread.submit(self._look)
            return known

    def _look(self) -> Readiness:
        for name, (check, _) in _CHECKS.items():
            if name not in self._running:
                self._running[name] = _started(check)
        wait(self._running.values(), CHECK_SECONDS)
        checks = [self._result(name, failure) for name, (_, failure) in _CHECKS.items()]
        self._ended = time.monotonic()
        return Readiness(ready=all(check.ok for check in checks), checks=checks)

    def _result(self, name: CheckName, failure: str) -> Check:
        if not self._running[name].done():
            log.warning("not_ready", check=name, error="TimeoutError")
            return Check(name=name, ok=False, detail=failure)
        ended = self._running.pop(name)
        try:
            detail = ended.result()
        except Exception as error:
            # Every error means the same here, and its text may contain an address or a password.
            log.warning("not_ready", check=name, error=type(error).__name__)
            detail = failure
        return Check(name=name, ok=not detail, detail=detail)


def _started(check: Callable[[], str]) -> Future[str]:
    """Begin a check in a thread of its own.

    The end of the service does not wait for it.
    """
    future: Future[str] = Future()

    def run() -> None:
        try:
            future.set_result(check())
        except Exception as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


@router.get(
    "/v1/ready",
    summary="Ready",
    response_model=Readiness,
    responses={503: {"model": Readiness, "description": "A part is missing; the checks name it."}},
)
async def ready(request: Request, response: Response) -> Readiness:
    """Report whether database, broker, files, a worker and the queue are ready.

    It is open to all. All callers within a second get the same answer.
    """
    watch: ReadinessWatch = request.app.state.readiness
    answer = await asyncio.wrap_future(watch.answer())
    if not answer.ready:
        response.status_code = 503
    return answer
