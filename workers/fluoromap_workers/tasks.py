"""The one task that Celery registers, and the sweeper that each worker runs."""

from __future__ import annotations

import contextlib
import gc
import os
import socket
import time
from typing import Any

import structlog
from celery import bootsteps, shared_task
from celery.signals import celeryd_init, worker_process_init
from sqlalchemy.exc import SQLAlchemyError

from fluoromap_service.jobs import job_life, queue
from fluoromap_service.store.engine import forget_connections, reading, writing
from fluoromap_workers.pool_child import limit_memory, warm_up
from fluoromap_workers.runner import finish_known, run

SWEEP_SECONDS = 1.0

log = structlog.get_logger(__name__)


@shared_task(name=queue.RUN_STAGE)  # type: ignore[untyped-decorator,unused-ignore]
def run_stage(stage_id: int) -> None:
    """Run the stage of that row, then for a while others of its job.

    A stage that cannot be claimed is left alone. After a stage, this worker runs the stages of the same job that are ready, and
    does not wait for their messages. A message that arrives later finds its stage claimed.
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
    """Make a pool child ready for its first stage.

    It gets its own connections and bounded memory, loads the plugins and compiles the kernels.
    """
    forget_connections()
    limit_memory()
    warm_up()
    # The loaded code stays. Else the collector would walk through it again while a stage makes its small objects.
    gc.freeze()


class Sweeper(bootsteps.StartStopStep):  # type: ignore[misc]
    """Sweeps every second from the worker's own timer, and stores that the worker lives."""

    requires = frozenset({"celery.worker.components:Timer"})

    def __init__(self, parent: Any, **options: Any) -> None:
        self.entry: Any = None

    def start(self, parent: Any) -> None:
        self.entry = parent.timer.call_repeatedly(SWEEP_SECONDS, self.sweep, (parent.hostname,))

    def stop(self, parent: Any) -> None:
        if self.entry is not None:
            self.entry.cancel()

    def sweep(self, name: str) -> None:
        # The worker outlives a database that is away for a moment: the next sweep finds it again.
        with contextlib.suppress(SQLAlchemyError):
            with writing() as session:
                job_life.worker_seen(session, name)
            queue.sweep()


@celeryd_init.connect
def add_sweeper(instance: Any, **_: Any) -> None:
    """Give the worker that starts a sweeper."""
    instance.app.steps["worker"].add(Sweeper)
