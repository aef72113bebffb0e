"""The API, a worker, the DICOM listener and the sender as child processes of one command."""

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

from fluoromap_service.cli.environment import SUPERVISOR
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.folder_lock import only_one
from fluoromap_service.cli.own_token import read_token

STOP_SECONDS = 30.0
"""Longest time that the children get to stop."""
READY_SECONDS = 180.0
"""Longest time until the service must be ready. The first start compiles kernels."""
LONGEST_BACKOFF_SECONDS = 30.0
"""Longest wait before a child that dies again and again is restarted."""
STEADY_SECONDS = 60.0
"""A child that dies after this time is restarted at once. A younger one may be silent, because it still starts."""
LOOK_SECONDS = 2.0
"""Time between two looks at a running service."""
SILENT_SECONDS = 30.0
"""An API that gives no answer for this time hangs."""


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


def url_of(host: str, port: int) -> str:
    """Return the address at which programs of this machine reach a service.

    An IPv6 address has brackets. A service that listens on every address is reached on the loopback address.
    """
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


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
        # The child ends with this process, even when this process is killed.
        environment = self.environment | {SUPERVISOR: str(os.getpid())}
        # In a session of its own the child does not receive Ctrl-C. The supervisor receives it and stops the children in order.
        self.process = subprocess.Popen(
            [program(), *self.arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=environment,
            start_new_session=True,
        )
        if output is not None:
            output.close()
        self.start_time = time.monotonic()
        self.restart_at = None

    @property
    def name(self) -> str:
        return self.arguments[0]

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    @property
    def steady(self) -> bool:
        return time.monotonic() - self.start_time > STEADY_SECONDS

    def restart_when_dead(self) -> None:
        """Start a dead child again.

        It starts at once when it had lived long, else after a longer and longer time.
        """
        if self.alive:
            return
        now = time.monotonic()
        if self.restart_at is None:
            # The processes that a dead child left behind would work beside the new ones.
            self.kill_group()
            self.deaths = 1 if self.steady else self.deaths + 1
            delay = 0.0 if self.deaths == 1 else min(2.0 ** (self.deaths - 2), LONGEST_BACKOFF_SECONDS)
            self.restart_at = now + delay
            print(f"fluoromap: the {self.name} died; starting it again in {delay:.0f} s", file=sys.stderr, flush=True)
        if now >= self.restart_at:
            self.start()

    def kill_group(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


class Supervisor:
    """The parent of the service's processes: it starts them, restarts each when it dies or hangs, and stops them.

    They are the API, the worker, and where they are wanted the DICOM listener and the sender of results.

    Parameters
    ----------
    host, port
        Address of the API.
    environment : mapping
        Environment of the children, with the FLUOROMAP_* settings.
    log_folder : Path, optional
        Folder of ``worker.log`` and ``api.log``, the output of the children. By default they use this process's output.
    dicom, sender : bool, optional
        Whether to run the DICOM listener and the sender too. The supervisor restarts them when they die; it does not look
        whether they hang.
    worker : bool, optional
        Whether to run a worker. Without one the API takes files and shows them, and is ready as soon as it answers.
    """

    def __init__(
        self,
        host: str,
        port: int,
        environment: Mapping[str, str],
        log_folder: Path | None = None,
        *,
        dicom: bool = False,
        sender: bool = False,
        worker: bool = True,
    ) -> None:
        settings = dict(environment) | {"FLUOROMAP_HOST": host, "FLUOROMAP_PORT": str(port)}
        self._worker = _Child(["worker"], log_folder and log_folder / "worker.log", settings)
        self._api = _Child(["api"], log_folder and log_folder / "api.log", settings)
        self._children = [self._api, self._worker] if worker else [self._api]
        self._ready_path = "/v1/ready" if worker else "/v1/health"
        for name in ["dicom-listener"] * dicom + ["sender"] * sender:
            self._children.append(_Child([name], log_folder and log_folder / f"{name}.log", settings))
        self._log_folder = log_folder
        self._was_ready = False
        self._next_look = self._last_answer = 0.0
        self.url = url_of(host, port)

    def start(self) -> None:
        """Start all children."""
        for child in reversed(self._children):
            child.start()

    def wait_until_ready(self, stop: threading.Event | None = None) -> None:
        """Wait until the API reports that it and the worker are ready.

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
                    if client.get(f"{self.url}{self._ready_path}").status_code == 200:
                        self._was_ready = True
                        return
                time.sleep(0.1)
        if not (stop and stop.is_set()):
            raise CommandFailed(f"The service was not ready within {READY_SECONDS:.0f} s; {self._where_to_look()}.")

    def check_children(self) -> None:
        """Check the children once and restart a dead one.

        Raises
        ------
        CommandFailed
            When the API ends before the service was ready: another start would end in the same way.
        """
        if not self._was_ready and not self._api.alive:
            raise CommandFailed(f"The API ended unexpectedly; {self._where_to_look()}.")
        for child in self._children:
            child.restart_when_dead()

    def check_service(self) -> None:
        """Look at the running service every ``LOOK_SECONDS``, and kill a child that hangs.

        The next :meth:`check_children` starts it again. A worker hangs when it gives no sign of life while the database answers.
        A worker that lives and takes no stage ends itself.
        """
        now = time.monotonic()
        if now < self._next_look:
            return
        self._next_look = now + LOOK_SECONDS
        with httpx.Client(base_url=self.url, trust_env=False, timeout=5) as client, suppress(httpx.HTTPError):
            client.get("/v1/health")
            self._last_answer = time.monotonic()
            checks = {check["name"]: check["ok"] for check in client.get("/v1/ready").json()["checks"]}
            if checks["database"] and not checks["worker"]:
                self._kill_hanging(self._worker)
        if time.monotonic() - max(self._last_answer, self._api.start_time) > SILENT_SECONDS:
            self._kill_hanging(self._api)

    def _kill_hanging(self, child: _Child) -> None:
        if child.steady and child.alive:
            print(f"fluoromap: the {child.name} hangs; killing it", file=sys.stderr, flush=True)
            child.kill_group()

    def stop(self) -> None:
        """Ask all children to stop, wait up to STOP_SECONDS, then kill them."""
        children = [child for child in self._children if hasattr(child, "process")]
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
            supervisor.check_service()
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


@dataclass(frozen=True, slots=True)
class PrivateService:
    """A service that only its user can use.

    Parameters
    ----------
    url : str
        Its address.
    token : str
        The access token of its data folder.
    environment : dict of str to str
        The environment of its processes.
    """

    url: str
    token: str = field(repr=False)
    environment: dict[str, str] = field(repr=False)

    def client(self) -> httpx.Client:
        """Return an HTTP client that sends the token."""
        headers = {"Authorization": f"Bearer {self.token}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=600, trust_env=False)

    def sign_in_link(self) -> str:
        """Return a new link that signs a browser in.

        Raises
        ------
        CommandFailed
            When the database cannot be used.
        """
        return _sign_in_link(self.environment)


def _sign_in_link(environment: dict[str, str]) -> str:
    """Return a link that signs a browser in.

    The database is migrated, and the data folder gets a token, where needed.
    """
    # Another process: this one has the settings of its user, not those of the private service.
    answer = subprocess.run(
        [program(), "sign-in"], env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    if answer.returncode != 0:
        raise CommandFailed(answer.stderr.strip().removeprefix("fluoromap: ") or "The database cannot be made.")
    return answer.stdout.strip()


@contextmanager
def private_service(data_dir: Path, *, workers: int | None = None, computes: bool = True) -> Iterator[PrivateService]:
    """Run the service on one data folder, with an access token of its own.

    It listens on a free port of the loopback address. It ignores the FLUOROMAP_* variables of this user, so that it cannot
    touch the database or broker of another service.

    Parameters
    ----------
    data_dir : Path
        Folder of the files, the database and the broker.
    workers : int, optional
        Number of stages that run at the same time; by default one a processor.
    computes : bool, optional
        Whether a worker runs too. It takes longer to start than the API.

    Raises
    ------
    CommandFailed
        When another service runs on the folder, the database cannot be made or the service is not ready in time.
    """
    with only_one(data_dir):
        yield from _served(data_dir, workers, computes)


def _served(data_dir: Path, workers: int | None, computes: bool) -> Iterator[PrivateService]:
    port = free_port()
    environment = {key: value for key, value in os.environ.items() if not key.startswith("FLUOROMAP_")}
    environment |= {"FLUOROMAP_DATA_DIR": str(data_dir.resolve()), "FLUOROMAP_PORT": str(port)}
    if workers is not None:
        environment["FLUOROMAP_WORKERS"] = str(workers)
    _sign_in_link(environment)
    token = read_token(data_dir)
    assert token is not None
    supervisor = Supervisor("127.0.0.1", port, environment, log_folder=data_dir, worker=computes)
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        # The default action ends this process at once and leaves its children running.
        signal.signal(signal.SIGTERM, _exit)
    stop = threading.Event()
    watcher = threading.Thread(target=_watch, args=(supervisor, stop), daemon=True)
    try:
        supervisor.start()
        supervisor.wait_until_ready()
        watcher.start()
        yield PrivateService(supervisor.url, token, environment)
    finally:
        stop.set()
        if watcher.is_alive():
            watcher.join()
        supervisor.stop()


def _watch(supervisor: Supervisor, stop: threading.Event) -> None:
    while not stop.wait(0.2):
        supervisor.check_children()
