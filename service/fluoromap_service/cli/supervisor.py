"""The API and a worker as child processes of one command, for the embedded default: no server needed."""

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

STOP_SECONDS = 30.0
READY_SECONDS = 180.0
LONGEST_BACKOFF_SECONDS = 30.0
STEADY_SECONDS = 60.0
"""A worker that lived this long is restarted at once when it dies."""


class CommandFailed(Exception):
    """A command could not do its work; the message is one sentence for the user that says what to do."""


def program() -> str:
    """The installed ``fluoromap`` program of this Python."""
    found = shutil.which("fluoromap", path=sysconfig.get_path("scripts")) or shutil.which("fluoromap")
    if found is None:
        raise CommandFailed("The program fluoromap is not installed beside this Python; install the package again.")
    return found


def free_port() -> int:
    """A port of the loopback address that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def check_port(host: str, port: int) -> None:
    """Refuse an address that cannot be listened on, before anything is started.

    Raises
    ------
    CommandFailed
        Saying why.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise CommandFailed(
            f"Cannot listen on {host} port {port} ({error.strerror}); choose another with --host or --port."
        ) from error


@dataclass
class _Child:
    arguments: list[str]
    log: Path | None
    environment: dict[str, str]
    process: subprocess.Popen[bytes] = field(init=False)
    started: float = field(init=False)
    deaths: int = 0
    restart_at: float | None = None

    def start(self) -> None:
        output: IO[bytes] | None = self.log.open("ab") if self.log else None
        # A group of its own: Ctrl-C in a terminal reaches the supervisor alone, which then stops its children in order.
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
        self.started = time.monotonic()
        self.restart_at = None

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def kill_group(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


class Supervisor:
    """Starts the worker and the API, restarts a worker that died, stops both.

    Parameters
    ----------
    host, port
        Where the API listens.
    environment : mapping
        The children's environment; holds the FLUOROMAP_* settings.
    log_folder : Path, optional
        Where the children's output goes, ``worker.log`` and ``api.log``; by default to this process's own.
    """

    def __init__(self, host: str, port: int, environment: Mapping[str, str], log_folder: Path | None = None) -> None:
        settings = dict(environment) | {"FLUOROMAP_HOST": host, "FLUOROMAP_PORT": str(port)}
        self._worker = _Child(["worker"], log_folder and log_folder / "worker.log", settings)
        self._api = _Child(["api"], log_folder and log_folder / "api.log", settings)
        self._log_folder = log_folder
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{port}"

    def start(self) -> None:
        self._worker.start()
        self._api.start()

    def wait_until_ready(self, stop: threading.Event | None = None) -> None:
        """Return when the API answers and a worker has been seen, or when ``stop`` is set before.

        Raises
        ------
        CommandFailed
            When that does not happen.
        """
        import httpx

        end = time.monotonic() + READY_SECONDS
        with httpx.Client(trust_env=False, timeout=5) as client:
            while time.monotonic() < end and not (stop and stop.is_set()):
                self.tend()
                with suppress(httpx.HTTPError):
                    if client.get(f"{self.url}/v1/ready").status_code == 200:
                        return
                time.sleep(0.1)
        if not (stop and stop.is_set()):
            raise CommandFailed(self._not_ready())

    def _not_ready(self) -> str:
        return f"The service did not get ready within {READY_SECONDS:.0f} s; {self._where_to_look()}."

    def tend(self) -> None:
        """Look after the children once: restart a worker that died, later each time it dies young.

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
            # What the dead worker left running would compute beside its successor.
            worker.kill_group()
            steady = now - worker.started > STEADY_SECONDS
            worker.deaths = 1 if steady else worker.deaths + 1
            delay = 0.0 if worker.deaths == 1 else min(2.0 ** (worker.deaths - 2), LONGEST_BACKOFF_SECONDS)
            worker.restart_at = now + delay
            print(f"fluoromap: the worker died; starting it again in {delay:.0f} s", file=sys.stderr, flush=True)
        if now >= worker.restart_at:
            worker.start()

    def stop(self) -> None:
        """Ask both to stop, let running stages end for a while, then make sure."""
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
            # Also when the user would not wait and pressed Ctrl-C again.
            for child in children:
                child.kill_group()

    def _where_to_look(self) -> str:
        return f"see the logs in {self._log_folder}" if self._log_folder else "its own message stands above"


def run_until_stopped(supervisor: Supervisor, stop: threading.Event, on_ready: Callable[[], None]) -> None:
    """Start the children, tend them until ``stop`` is set, then stop them; ``on_ready`` is called when they can be used."""
    try:
        supervisor.start()
        supervisor.wait_until_ready(stop)
        if not stop.is_set():
            on_ready()
        while not stop.wait(0.2):
            supervisor.tend()
    finally:
        supervisor.stop()


def stop_on_signals() -> threading.Event:
    """An event that the first SIGINT or SIGTERM sets; a second one interrupts the process."""
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
    """The whole service on a free port of the loopback address and on that data folder alone; gives its address.

    A database or broker configured for this user's own service is left alone.
    """
    data_dir.mkdir(parents=True, exist_ok=True)
    environment = {key: value for key, value in os.environ.items() if not key.startswith("FLUOROMAP_")}
    environment["FLUOROMAP_DATA_DIR"] = str(data_dir.resolve())
    migrated = subprocess.run(
        [program(), "db", "upgrade"], env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    if migrated.returncode != 0:
        raise CommandFailed(migrated.stderr.strip() or "The database could not be made.")
    supervisor = Supervisor("127.0.0.1", free_port(), environment, log_folder=data_dir)
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        # The default would end this process at once and leave its children running.
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
    # When the API has ended the client that talks to it is told by the connection.
    with suppress(CommandFailed):
        while not stop.wait(0.2):
            supervisor.tend()
