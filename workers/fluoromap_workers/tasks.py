"""The one task that Celery registers, and what each worker starts beside it: its processes and its sweeper."""

from __future__ import annotations

import os
import queue as waiting_line
import socket
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import structlog
from celery import bootsteps, shared_task
from celery.signals import celeryd_init, worker_shutting_down
from sqlalchemy.exc import SQLAlchemyError

from fluoromap_service.jobs import living_workers, queue, turns
from fluoromap_service.jobs.pipeline import STAGES
from fluoromap_service.jobs.stall import StallWatch
from fluoromap_service.jobs.turns import ReadyStage
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import reading, writing
from fluoromap_workers.drain import Drain
from fluoromap_workers.runner import THIS_PROCESS, Place, run
from fluoromap_workers.stage_process import StageProcess

SWEEP_SECONDS = 1.0
STALLED_EXIT_CODE = 75
"""EX_TEMPFAIL of <sysexits.h>: another start may help."""

log = structlog.get_logger(__name__)

_drain = Drain()
_all_processes: list[StageProcess] = []
_free_processes: waiting_line.LifoQueue[StageProcess] = waiting_line.LifoQueue()


@shared_task(name=queue.RUN_STAGE)  # type: ignore[untyped-decorator,unused-ignore]
def run_stage(stage_id: int) -> None:
    """Run stages until none is ready, the most urgent first.

    The message of a stage only wakes the worker: :func:`turns.most_urgent` says which stage it takes. A message that arrives
    later finds its stage claimed.
    """
    try:
        with _place() as place:
            _run_stages(place)
    except SQLAlchemyError as error:
        if settings().eager:
            raise
        # The stage stays ready, and is announced again.
        log.warning("stage_not_claimed", stage=stage_id, error=type(error).__name__)


@contextmanager
def _place() -> Iterator[Place]:
    """Give a place to run stages.

    It is this process when jobs run at once, else one of the worker's processes.
    """
    if settings().eager:
        yield THIS_PROCESS
        return
    process = _free_processes.get()
    try:
        yield process
    finally:
        _free_processes.put(process)


def _run_stages(place: Place) -> None:
    worker = f"{socket.gethostname()}:{os.getpid()}"
    while place.is_ready():
        with reading() as session:
            urgent = turns.most_urgent(session)
        if urgent is None:
            return
        if STAGES[urgent.name].subject == "study" or not _comparisons.compare(urgent, place):
            run(urgent.stage_id, worker, place, _announce)
    _announce()


class Comparisons:
    """The kinds of stages, each of one job, whose stored results this worker has looked for.

    After a correction nearly all results of a kind are known. One thread ends their stages; the others wait for it, else they
    would read and compare the same again.
    """

    _REMEMBERED = 64

    def __init__(self) -> None:
        self._locks: OrderedDict[tuple[str, str], threading.Lock] = OrderedDict()
        self._compared: set[tuple[str, str]] = set()
        self._own = threading.Lock()

    def compare(self, urgent: ReadyStage, place: Place) -> bool:
        """End the stages of this kind whose results are stored.

        Return False when a thread has done so before.
        """
        kind = urgent.job_id, urgent.name
        with self._own:
            lock = self._locks.setdefault(kind, threading.Lock())
            while len(self._locks) > self._REMEMBERED:
                self._compared.discard(self._locks.popitem(last=False)[0])
        with lock:
            if kind in self._compared:
                return False
            place.finish_known(urgent.job_id)
            self._compared.add(kind)
            return True


_comparisons = Comparisons()


def _announce() -> None:
    """Announce the stages that are ready.

    The worker takes its own next stage without an announcement. So it claims that stage first, and wakes other workers meanwhile.
    """
    try:
        queue.publish_due()
    except SQLAlchemyError as error:
        if settings().eager:
            raise
        # The stages stay ready, and the sweep announces them.
        log.warning("stages_not_announced", error=type(error).__name__)


class Processes(bootsteps.StartStopStep):  # type: ignore[misc]
    """The worker's stage processes, started with it and ended after its threads."""

    requires = frozenset({"celery.worker.components:Pool"})

    def start(self, parent: Any) -> None:
        for _ in range(settings().workers):
            process = StageProcess(_drain)
            process.start()
            _all_processes.append(process)
            _free_processes.put(process)

    def terminate(self, parent: Any) -> None:
        for process in _all_processes:
            process.kill()


class Sweeper(bootsteps.StartStopStep):  # type: ignore[misc]
    """Sweeps every second from the worker's own timer, and stores that the worker lives.

    It ends the worker when stages wait and nobody runs one: then the worker no longer takes messages. The supervisor or the
    container restarts it.
    """

    requires = frozenset({"celery.worker.components:Timer"})

    def __init__(self, parent: Any, **options: Any) -> None:
        self.entry: Any = None
        self._stall = StallWatch()

    def start(self, parent: Any) -> None:
        self.entry = parent.timer.call_repeatedly(SWEEP_SECONDS, self.sweep, (parent.hostname,))

    def stop(self, parent: Any) -> None:
        if self.entry is not None:
            self.entry.cancel()

    def sweep(self, name: str) -> None:
        # The worker outlives a database that is away for a moment: the next sweep finds it again.
        try:
            with writing() as session:
                living_workers.worker_seen(session, name)
            queue.sweep()
            with reading() as session:
                stalled = self._stall.look(session)
        except SQLAlchemyError:
            self._stall.reset()
            return
        # At the very first start a process compiles its kernels before it takes a stage.
        if any(process.is_starting for process in _all_processes):
            self._stall.reset()
            return
        if stalled and not _drain.begun:
            log.error("worker_stalled")
            # The threads may wait for ever; the processes end with this one.
            os._exit(STALLED_EXIT_CODE)


@celeryd_init.connect
def add_steps(instance: Any, **_: Any) -> None:
    """Give the worker that starts its processes and a sweeper."""
    instance.app.steps["worker"].update({Processes, Sweeper})


@worker_shutting_down.connect
def begin_drain(**_: Any) -> None:
    """Take no new stage; the running ones get ``DRAIN_SECONDS``."""
    _drain.begin()
