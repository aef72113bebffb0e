"""The signs of life of a claimed stage: they extend its lease, store its progress and learn whether it is still wanted."""

from __future__ import annotations

import threading
import time
from types import TracebackType
from typing import Literal

import structlog
from sqlalchemy.exc import SQLAlchemyError

from fluoromap.contracts import StageStopped
from fluoromap_service.jobs import job_life
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import reading, writing

LOOK_SECONDS = 0.5
CANCEL_SECONDS = 2.0
"""Longest time until a running stage learns that its job was cancelled."""

log = structlog.get_logger(__name__)

Answer = Literal["alive", "cancelled", "lost"]


class Beats:
    """The signs of life of one claimed stage. Only one thread may send them.

    Call :meth:`send_if_due` every ``LOOK_SECONDS``. It stores the progress when it has changed, and extends the lease at least
    every ``heartbeat_seconds``.
    """

    def __init__(self, held: job_life.Claim) -> None:
        self.fraction = 0.0
        self._held = held
        self._stored = 0.0
        self._last_beat = self._last_look = time.monotonic()

    def send_if_due(self) -> Answer:
        """Send a sign of life when it is time.

        Return whether the work is still wanted.
        """
        now = time.monotonic()
        try:
            if now - self._last_beat >= settings().heartbeat_seconds or self.fraction != self._stored:
                fraction = self.fraction
                with writing() as session:
                    answer = job_life.beat(session, self._held, fraction)
                self._stored, self._last_beat, self._last_look = fraction, now, now
                return answer
            if now - self._last_look >= CANCEL_SECONDS:
                self._last_look = now
                with reading() as session:
                    return "cancelled" if job_life.cancel_requested(session, self._held.job_id) else "alive"
        except SQLAlchemyError as error:
            log.warning("heartbeat_missed", stage=self._held.stage_id, error=type(error).__name__)
        return "alive"


class Heartbeat:
    """The :class:`fluoromap.contracts.Context` of a stage that runs in this process; a thread sends its signs of life."""

    def __init__(self, held: job_life.Claim) -> None:
        self._beats = Beats(held)
        self._unwanted: Answer = "alive"
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def progress(self, fraction: float) -> None:
        self._beats.fraction = min(max(float(fraction), 0.0), 1.0)

    def check(self) -> None:
        if self._unwanted != "alive":
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
        while not self._end.wait(LOOK_SECONDS):
            answer = self._beats.send_if_due()
            if answer != "alive":
                self._unwanted = answer
                return
