"""The sign of life of a running stage, sent by a thread beside it. Kernels release the interpreter lock."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Literal

import structlog
from sqlalchemy.exc import SQLAlchemyError

from fluoromap.contracts import StageStopped
from fluoromap_service.jobs import job_life
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import writing

LOOK_SECONDS = 0.5

log = structlog.get_logger(__name__)


class Heartbeat:
    """A stage's :class:`fluoromap.contracts.Context`, whose thread extends the lease while the stage runs.

    The thread stores progress when it changed, at most twice a second. It extends the lease at least every
    ``heartbeat_seconds``. When the job is cancelled or the claim is lost, the stage's next check raises.
    """

    def __init__(self, held: job_life.Claim) -> None:
        self._held = held
        self._fraction = 0.0
        self._unwanted: Literal["cancelled", "lost"] | None = None
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def progress(self, fraction: float) -> None:
        self._fraction = min(max(float(fraction), 0.0), 1.0)

    def check(self) -> None:
        if self._unwanted is not None:
            raise StageStopped(self._unwanted)

    @property
    def cancelled(self) -> bool:
        return self._unwanted == "cancelled"

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.set()
        self._thread.join()

    def _beat(self) -> None:
        stored, since = 0.0, 0.0
        while not self._end.wait(LOOK_SECONDS):
            since += LOOK_SECONDS
            if since < settings().heartbeat_seconds and self._fraction == stored:
                continue
            try:
                with writing() as session:
                    answer = job_life.beat(session, self._held, self._fraction)
            except SQLAlchemyError as error:
                log.warning("heartbeat_missed", stage=self._held.stage_id, error=type(error).__name__)
                continue
            stored, since = self._fraction, 0.0
            if answer != "alive":
                self._unwanted = answer
                return
