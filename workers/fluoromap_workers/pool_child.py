"""The life of a stage process: its preparation, then one stage after another, as its worker sends them."""

from __future__ import annotations

import gc
import os
import queue
import resource
import signal
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import structlog

from fluoromap.contracts import StageStopped
from fluoromap.registry import DEFAULTS, UnknownPlugin, plugin, plugins
from fluoromap_service import logs
from fluoromap_service.jobs.job_life import Claim
from fluoromap_service.parent_process import end_with_parent
from fluoromap_service.settings import settings
from fluoromap_workers import runner

PROGRESS_SECONDS = 0.5

COLLECTOR_THRESHOLDS = (20_000, 20, 50)
"""Rarer runs of the garbage collector than Python's own."""

log = structlog.get_logger(__name__)


class WorkerLink:
    """The :class:`fluoromap.contracts.Context` of the stages of this process, and the pipe to their worker.

    A thread reads the pipe. It ends the process when the worker has ended.
    """

    def __init__(self, connection: Connection) -> None:
        self.orders: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        self.running: Claim | None = None
        self._connection = connection
        self._stopped: Claim | None = None
        self._reported = 0.0
        self._lock = threading.Lock()
        threading.Thread(target=self._read, name="worker-link", daemon=True).start()

    def progress(self, fraction: float) -> None:
        now = time.monotonic()
        if now - self._reported >= PROGRESS_SECONDS:
            self._reported = now
            self.send("progress", min(max(float(fraction), 0.0), 1.0))

    def check(self) -> None:
        if self._stopped is not None and self._stopped == self.running:
            raise StageStopped("the worker asks the stage to stop")

    def send(self, *message: Any) -> None:
        """Send a message to the worker."""
        with self._lock:
            self._connection.send(message)

    def _read(self) -> None:
        try:
            while True:
                message = self._connection.recv()
                if message[0] == "stop":
                    self._stopped = message[1]
                else:
                    self.orders.put(message)
        except (EOFError, OSError):
            os._exit(0)


def serve(connection: Connection) -> None:
    """Run stages until the worker ends; ``connection`` is the pipe to the worker's thread."""
    # The parent is the server of forks, which ends with the worker.
    end_with_parent(os.getppid())
    # Ctrl-C reaches every process of a terminal; the worker ends its stages in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logs.configure()
    limit_memory()
    warm_up()
    # The loaded code stays. Else the collector would walk through it again while a stage makes its small objects.
    gc.freeze()
    # A stage makes thousands of small objects without cycles.
    gc.set_threshold(*COLLECTOR_THRESHOLDS)
    link = WorkerLink(connection)
    link.send("ready")
    while True:
        order, subject = link.orders.get()
        if order == "stage":
            link.running = subject
            runner.work(subject, link)
        else:
            runner.finish_known(subject)
        link.send("ended", _resident_mib())


def _resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1]) if Path("/proc/self/statm").exists() else 0
    return pages * resource.getpagesize() / 2**20


def limit_memory() -> None:
    """Bound the address space, so that a stage that grows without end fails alone."""
    limit = settings().worker_memory_mib * 2**20
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def warm_up() -> None:
    """Load the plugins and compile the kernels of the default ones.

    So the first run does not wait. A plugin may offer a class method ``warm_up()``. A failure there is logged; later the
    stage reports it to the user.
    """
    # Compiling makes millions of objects and keeps most: the collector would walk through them a thousand times.
    gc.disable()
    for row in plugins():
        if row.error is not None:
            log.warning("plugin_broken", kind=row.kind, plugin=row.name)
    for kind, name in DEFAULTS.items():
        try:
            prepare = getattr(plugin(kind, name).stage, "warm_up", None)
            if prepare is not None:
                prepare()
        except UnknownPlugin:
            log.warning("plugin_missing", kind=kind, plugin=name)
        except Exception:
            log.warning("plugin_not_warm", kind=kind, plugin=name, exc_info=True)
    gc.enable()
    gc.collect()
