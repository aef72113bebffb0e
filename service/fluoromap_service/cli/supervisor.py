"""The API and a worker as child processes of one command."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import httpx

from fluoromap_service.cli.failures import CommandFailed

STOP_SECONDS = 30.0
"""Longest time that the children get to stop."""
READY_SECONDS = 180.0
"""Longest time until the service must be ready. The first start compiles kernels."""
LONGEST_BACKOFF_SECONDS = 30.0
"""Longest wait before a worker that dies again and again is restarted."""
STEADY_SECONDS = 60.0
"""A worker that dies after this time is restarted at once."""


def program() -> str:
    """Return the path of the ``fluoromap`` program that belongs to this Python."""
    found = shutil.which("fluoromap", path=sysconfig.get_path("scripts")) or shutil.which("fluoromap")
    if found is None:
        raise CommandFailed(
            "The program fluoromap is missing in this Python's environment; install the package fluoromap again."
        )
    return found


def free_port() -> int:
    """Return a port of the loopback address that is not in use."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def check_port(host: str, port: int) -> None:
    """Check that the API can listen on an address.

    Raises
    ------
    CommandFailed
        When it cannot; the message says why.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise CommandFailed(
            f"Cannot listen on {host} port {port} ({error.strerror}); choose another address with --host or --port."
        ) from error


@dataclass
class _Child:
    arguments: list[str]
    log: Path | None
    environment: dict[str, str]
    process: subprocess.Popen[bytes] = field(init=False)
    start_time: float = field(init=False)
    deaths: int = 0
    restart_at: float | None = None

    def start(self) -> None:
        output: IO[bytes] | None = self.log.open("ab") if self.log else None
        # In a session of its own the child does not receive Ctrl-C. The supervisor receives it and stops the children in order.
        self.process = subprocess.Popen(
            [program(), *self.arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=self.environment,
            start_new_session=True,
        )
        if output is not None:
            output.close()
        self.start_time = time.monotonic()
        self.restart_at = None

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def kill_group(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


class Supervisor:
    """The parent of the API and the worker: it starts both, restarts a dead worker and stops both.

    Parameters
    ----------
    host, port
        Address of the API.
    environment : mapping
        Environment of the children, with the FLUOROMAP_* settings.
    log_folder : Path, optional
        Folder of ``worker.log`` and ``api.log``, the output of the children. By default they use this process's output.
    """

    def __init__(self, host: str, port: int, environment: Mapping[str, str], log_folder: Path | None = None) -> None:
        settings = dict(environment) | {"FLUOROMAP_HOST": host, "FLUOROMAP_PORT": str(port)}
        self._worker = _Child(["worker"], log_folder and log_folder / "worker.log", settings)
        self._api = _Child(["api"], log_folder and log_folder / "api.log", settings)
        self._log_folder = log_folder
        # An IPv6 address has brackets in a URL.
        address = f"[{host}]" if ":" in host else host
        self.url = f"http://{address}:{port}"

    def start(self) -> None:
        """Start the worker and the API."""
        self._worker.start()
        self._api.start()

    def wait_until_ready(self, stop: threading.Event | None = None) -> None:
        """Wait until the API reports that it and a worker are ready.

        Parameters
        ----------
        stop : Event, optional
            Ends the waiting without an error when it is set.

        Raises
        ------
        CommandFailed
            When the service is not ready within READY_SECONDS.
        """
        end = time.monotonic() + READY_SECONDS
        with httpx.Client(trust_env=False, timeout=5) as client:
            while time.monotonic() < end and not (stop and stop.is_set()):
                self.check_children()
                with suppress(httpx.HTTPError):
                    if client.get(f"{self.url}/v1/ready").status_code == 200:
                        return
                time.sleep(0.1)
        if not (stop and stop.is_set()):
            raise CommandFailed(f"The service was not ready within {READY_SECONDS:.0f} s; {self._where_to_look()}.")

    def check_children(self) -> None:
        """Check the children once and restart a dead worker.

        A worker that dies again and again is restarted after a longer and longer time.

        Raises
        ------
        CommandFailed
            When the API has ended.
        """
        if not self._api.alive:
            raise CommandFailed(f"The API ended unexpectedly; {self._where_to_look()}.")
        worker = self._worker
        if worker.alive:
            return
        now = time.monotonic()
        if worker.restart_at is None:
            # The pool processes of a dead worker would compute beside the new worker.
            worker.kill_group()
            steady = now - worker.start_time > STEADY_SECONDS
            worker.deaths = 1 if steady else worker.deaths + 1
            delay = 0.0 if worker.deaths == 1 else min(2.0 ** (worker.deaths - 2), LONGEST_BACKOFF_SECONDS)
            worker.restart_at = now + delay
            print(f"fluoromap: the worker died; starting it again in {delay:.0f} s", file=sys.stderr, flush=True)
        if now >= worker.restart_at:
            worker.start()

    def stop(self) -> None:
        """Ask both children to stop, wait up to STOP_SECONDS, then kill them."""
        children = [child for child in (self._api, self._worker) if hasattr(child, "process")]
        for child in children:
            if child.alive:
                child.process.terminate()
        end = time.monotonic() + STOP_SECONDS
        try:
            for child in children:
                with suppress(subprocess.TimeoutExpired):
                    child.process.wait(max(end - time.monotonic(), 0.1))
        finally:
            # A second Ctrl-C interrupts the waiting; the children must end in that case too.
            for child in children:
                child.kill_group()

    def _where_to_look(self) -> str:
        return f"read the logs in {self._log_folder}" if self._log_folder else "read its message above"


def run_until_stopped(supervisor: Supervisor, stop: threading.Event, on_ready: Callable[[], None]) -> None:
    """Run the children until ``stop`` is set.

    Parameters
    ----------
    supervisor : Supervisor
        Parent of the children.
    stop : Event
        Ends the run.
    on_ready : callable
        Called once, when the service is ready.
    """
    try:
        supervisor.start()
        supervisor.wait_until_ready(stop)
        if not stop.is_set():
            on_ready()
        while not stop.wait(0.2):
            supervisor.check_children()
    finally:
        supervisor.stop()


def stop_on_signals() -> threading.Event:
    """Return an event that the first SIGINT or SIGTERM sets; a second signal ends the process."""
    event = threading.Event()

    def stop(number: int, frame: object) -> None:
        event.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, _exit)

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    return event


def _exit(number: int, frame: object) -> None:
    sys.exit(128 + number)


@contextmanager
def private_service(data_dir: Path) -> Iterator[str]:
    """Run the whole service on one data folder and yield its address.

    It listens on a free port of the loopback address. It ignores the FLUOROMAP_* variables of this user, so that it cannot
    touch the database or broker of another service.

    Raises
    ------
    CommandFailed
        When the database cannot be made or the service is not ready in time.
    """
    data_dir.mkdir(parents=True, exist_ok=True)
    environment = {key: value for key, value in os.environ.items() if not key.startswith("FLUOROMAP_")}
    environment["FLUOROMAP_DATA_DIR"] = str(data_dir.resolve())
    migration = subprocess.run(
        [program(), "db", "upgrade"], env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    if migration.returncode != 0:
        raise CommandFailed(
            migration.stderr.strip().removeprefix("fluoromap: ") or f"The database in {data_dir} cannot be made."
        )
    supervisor = Supervisor("127.0.0.1", free_port(), environment, log_folder=data_dir)
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        # The default action ends this process at once and leaves its children running.
        signal.signal(signal.SIGTERM, _exit)
    stop = threading.Event()
    watcher = threading.Thread(target=_watch, args=(supervisor, stop), daemon=True)
    try:
        supervisor.start()
        supervisor.wait_until_ready()
        watcher.start()
        yield supervisor.url
    finally:
        stop.set()
        if watcher.is_alive():
            watcher.join()
        supervisor.stop()


def _watch(supervisor: Supervisor, stop: threading.Event) -> None:
    # A client of a dead API fails by its own connection error.
    with suppress(CommandFailed):
        while not stop.wait(0.2):
            supervisor.check_children()
