"""What Celery registers: one task, and what a worker does besides."""

from __future__ import annotations

import contextlib
import gc
import os
import socket
import time
from typing import Any

import structlog
from celery import bootsteps
from celery.signals import worker_process_init
from sqlalchemy.exc import SQLAlchemyError

from fluoromap_service.jobs import job_life, queue
from fluoromap_service.store.engine import forget_connections, reading, writing
from fluoromap_workers.pool_child import limit_memory, warm_up
from fluoromap_workers.runner import finish_known, run

SWEEP_SECONDS = 1.0

log = structlog.get_logger(__name__)


@queue.app.task(name=queue.RUN_STAGE)
def run_stage(stage_id: int) -> None:
    """Run the stage of that row, if it is still to be had, and for a while what is ready of the same job.

    So a chain of short stages does not wait for a message each; the messages find their stages taken.
    """
    worker = f"{socket.gethostname()}:{os.getpid()}"
    end = time.monotonic() + queue.STAYS_SECONDS
    job = run(stage_id, worker)
    if job is None:
        return
    finish_known(job)
    queue.publish_due()
    while time.monotonic() <= end:
        with reading() as session:
            waiting = job_life.ready(session, job)
        if not waiting or run(waiting[0].stage_id, worker) is None:
            return
        queue.publish_due()


@worker_process_init.connect
def prepare_child(**_: Any) -> None:
    """Make a pool child ready: own connections, bounded memory, plugins loaded and kernels compiled."""
    forget_connections()
    limit_memory()
    warm_up()
    # What is loaded now stays: the collector would walk through it again and again while a stage makes its many small objects.
    gc.freeze()


class Sweeper(bootsteps.StartStopStep):  # type: ignore[misc]
    """Sweeps every second from the worker's own timer, and tells that the worker lives."""

    requires = frozenset({"celery.worker.components:Timer"})

    def __init__(self, parent: Any, **options: Any) -> None:
        self.entry: Any = None

    def start(self, parent: Any) -> None:
        self.entry = parent.timer.call_repeatedly(SWEEP_SECONDS, self.sweep, (parent.hostname,))

    def stop(self, parent: Any) -> None:
        if self.entry is not None:
            self.entry.cancel()

    def sweep(self, name: str) -> None:
        # A database that is away for a moment must not end the worker: the next sweep finds it again.
        with contextlib.suppress(SQLAlchemyError):
            with writing() as session:
                job_life.worker_seen(session, name)
            queue.sweep()


queue.app.steps["worker"].add(Sweeper)
