"""The processes in which a worker runs stages, one for each of its threads.

Each process has a pipe of its own, so the death of one cannot block another. The thread sends the stage's signs of life, so a
plugin that never releases the interpreter lock keeps its claim. The thread kills the process when the plugin does not stop.
"""

from __future__ import annotations

import multiprocessing
import time
from multiprocessing.connection import Connection
from typing import Any

import structlog
from sqlalchemy.exc import SQLAlchemyError

from fluoromap_service.jobs import job_life
from fluoromap_service.jobs.job_life import Claim
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import writing
from fluoromap_workers import pool_child
from fluoromap_workers.drain import Drain
from fluoromap_workers.heartbeat import LOOK_SECONDS, Answer, Beats
from fluoromap_workers.runner import Announce

GRACE_SECONDS = 5.0
"""Time that a stage gets to stop after its job was cancelled or its claim was lost."""
START_SECONDS = 180.0
"""Longest time until a process is ready for its first stage. The first one compiles kernels."""

log = structlog.get_logger(__name__)

_context = multiprocessing.get_context("forkserver")
# The server imports the libraries once. It has one thread, so its forks inherit no lock that another thread holds.
_context.set_forkserver_preload([pool_child.__name__])


class StageProcess:
    """A process that runs stages one after another. Only one thread at a time may use it."""

    def __init__(self, drain: Drain) -> None:
        self._drain = drain
        self._process: Any = None
        self._connection: Connection | None = None
        self._ready = False

    def start(self) -> None:
        """Start the process unless it lives."""
        if self._process is not None and self._process.is_alive():
            return
        self.kill()
        own, other = _context.Pipe()
        process = _context.Process(target=pool_child.serve, args=(other,), daemon=True)
        try:
            process.start()
        except (EOFError, OSError) as error:
            # Somebody killed the server of forks; the next start makes another one.
            log.warning("process_not_started", error=type(error).__name__)
            own.close()
            return
        finally:
            # With this end open the pipe would not close when the process dies.
            other.close()
        self._process, self._connection, self._ready = process, own, False

    @property
    def is_starting(self) -> bool:
        """Whether the process still prepares its first stage."""
        process, connection = self._process, self._connection
        if self._ready or process is None or connection is None:
            return False
        try:
            return bool(process.is_alive()) and not connection.poll()
        except (OSError, ValueError):
            # The thread of the process has just ended it.
            return False

    def is_ready(self) -> bool:
        """Start the process where needed and wait until it can run a stage.

        Return False when it cannot.
        """
        for _ in range(2):
            self.start()
            end = time.monotonic() + START_SECONDS
            while not self._ready and not self._drain.begun and time.monotonic() < end:
                try:
                    message = self._receive()
                except (EOFError, OSError):
                    break
                self._ready = message is not None and message[0] == "ready"
            if self._drain.begun:
                return False
            if self._ready:
                return True
            self.kill()
        log.warning("process_not_ready")
        return False

    def run(self, held: Claim, announce: Announce) -> None:
        """Run a claimed stage to its end, whatever its plugin does.

        When this returns, the stage has ended, or it waits for another attempt. The thread calls ``announce`` while the stage runs.
        """
        beats = Beats(held)
        now = time.monotonic()
        latest, kill_at = now + settings().stage_seconds, float("inf")
        answer: Answer = "alive"
        try:
            self._send("stage", held)
            announce()
            while True:
                message = self._receive()
                now = time.monotonic()
                if message is not None and message[0] == "progress":
                    beats.fraction = message[1]
                elif message is not None and message[0] == "ended":
                    self._end(held, answer)
                    self._replace_when_large(message[1])
                    return
                if answer == "alive":
                    answer = beats.send_if_due()
                    if answer != "alive":
                        kill_at = now + GRACE_SECONDS
                        self._send("stop", held)
                if now > kill_at:
                    log.warning("process_killed", stage=held.name, job=held.job_id, reason=answer)
                    self.kill()
                    self._end(held, answer)
                    return
                if now > latest:
                    self._fail_slow_stage(held)
                    return
                if self._drain.over:
                    log.info("stage_given_back", stage=held.name, job=held.job_id)
                    self.kill()
                    self._give_back(held)
                    return
        except (EOFError, OSError):
            log.warning("process_died", stage=held.name, job=held.job_id, attempt=held.attempt)
            self.kill()
            self._give_back(held)

    def finish_known(self, job_id: str) -> None:
        """End all ready stages of a job whose results are stored."""
        if self._connection is None:
            # The process was killed after the stage. The next stage starts another one.
            return
        end = time.monotonic() + settings().stage_seconds
        try:
            self._send("known", job_id)
            while time.monotonic() < end:
                message = self._receive()
                if message is not None and message[0] == "ended":
                    self._replace_when_large(message[1])
                    return
        except (EOFError, OSError):
            log.warning("process_died", job=job_id)
        self.kill()

    def kill(self) -> None:
        """End the process at once."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        if self._connection is not None:
            self._connection.close()
        self._process, self._connection, self._ready = None, None, False

    def _send(self, *message: Any) -> None:
        if self._connection is None:
            raise EOFError("the process has ended")
        self._connection.send(message)

    def _receive(self) -> tuple[Any, ...] | None:
        """Return the next message; None when none came within ``LOOK_SECONDS``."""
        if self._connection is None:
            raise EOFError("the process has ended")
        if not self._connection.poll(LOOK_SECONDS):
            return None
        message: tuple[Any, ...] = self._connection.recv()
        return message

    def _replace_when_large(self, resident_mib: float) -> None:
        if resident_mib > settings().worker_memory_mib / 2:
            self.kill()

    def _end(self, held: Claim, answer: Answer) -> None:
        """Store that a cancelled stage has stopped.

        Another worker stores the end of a stage whose claim was lost.
        """
        if answer == "cancelled":
            _store(lambda session: job_life.stopped(session, held))

    def _fail_slow_stage(self, held: Claim) -> None:
        log.warning("stage_too_slow", stage=held.name, job=held.job_id)
        self.kill()
        detail = (
            f"The stage {held.name!r} did not end within {settings().stage_seconds} s and was stopped. "
            "Choose another plugin, or raise FLUOROMAP_STAGE_SECONDS."
        )
        _store(lambda session: job_life.fail(session, held, {"code": "stage_too_slow", "detail": detail}))

    def _give_back(self, held: Claim) -> None:
        _store(lambda session: job_life.give_back(session, held))


def _store(change: Any) -> None:
    """Change the database; when it is away, the lease of the stage runs out instead."""
    try:
        with writing() as session:
            change(session)
    except SQLAlchemyError as error:
        log.warning("change_not_stored", error=type(error).__name__)
