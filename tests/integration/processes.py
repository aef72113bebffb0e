"""The program's processes, as a user starts them: with the embedded database, or with servers."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

import httpx
import psutil
import pytest

from fluoromap_service.cli.client import Client
from fluoromap_service.cli.own_token import read_token
from fluoromap_service.cli.supervisor import program

PATIENCE_SECONDS = 240


Fresh = Callable[[], AbstractContextManager[str]]
Kill = Callable[[], None]
"""Kills the worker without warning. Afterwards another worker starts."""


@contextmanager
def process(*arguments: str, environment: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    with (Path(environment["FLUOROMAP_DATA_DIR"]) / f"{arguments[0]}.log").open("ab") as log:
        process = subprocess.Popen(
            [program(), *arguments], env=environment, start_new_session=True, stdin=subprocess.DEVNULL,
            stdout=log, stderr=log,
        )  # fmt: skip
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(60)
        finally:
            kill_group(process.pid)


def kill_group(pid: int) -> None:
    try:
        os.killpg(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


@contextmanager
def embedded(environment: dict[str, str], port: int) -> Iterator[Kill]:
    """Start ``fluoromap up``, which restarts its worker by itself."""
    with process("up", "--port", str(port), environment=environment) as up:

        def kill() -> None:
            children = psutil.Process(up.pid).children()
            worker = next(child for child in children if "fluoromap worker" in " ".join(child.cmdline()))
            kill_group(worker.pid)

        yield kill


@contextmanager
def with_servers(environment: dict[str, str], port: int) -> Iterator[Kill]:
    """Start API and worker as separate programs, as on several machines.

    Without a token the service is open.
    """
    subprocess.run([program(), "db", "upgrade"], env=environment, check=True)
    with ExitStack() as stack:
        stack.enter_context(process("api", "--port", str(port), environment=environment))
        worker = stack.enter_context(process("worker", environment=environment))

        def kill() -> None:
            nonlocal worker
            kill_group(worker.pid)
            worker.wait()
            worker = stack.enter_context(process("worker", environment=environment))

        yield kill


def environment_of(data_dir: Path, **settings: str) -> dict[str, str]:
    data_dir.mkdir()
    environment = {key: value for key, value in os.environ.items() if not key.startswith("FLUOROMAP_")}
    return environment | {
        "FLUOROMAP_DATA_DIR": str(data_dir),
        "FLUOROMAP_WORKERS": "2",
        "FLUOROMAP_LEASE_SECONDS": "3",
        "FLUOROMAP_HEARTBEAT_SECONDS": "1",
        "FLUOROMAP_REPUBLISH_SECONDS": "1",
        **settings,
    }


def client_of(environment: dict[str, str], port: int) -> Client:
    """Return a client with the access token of the data folder.

    ``fluoromap up`` makes the token; without one the service is open.
    """
    return Client(f"http://127.0.0.1:{port}", read_token(Path(environment["FLUOROMAP_DATA_DIR"])))


def wait_until_ready(url: str, log_folder: Path) -> None:
    end = time.monotonic() + PATIENCE_SECONDS
    answer = None
    while time.monotonic() < end:
        try:
            answer = httpx.get(f"{url}/v1/ready", timeout=10)
            if answer.status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    logs = "\n".join(f"{path.name}: {path.read_text()[-2000:]}" for path in log_folder.glob("*.log"))
    pytest.fail(f"the service was not ready in time: {answer and answer.text}\n{logs}")


def until_printed(log: Path, text: str) -> str:
    """Wait until a log has a text, and return the whole log."""
    end = time.monotonic() + PATIENCE_SECONDS
    while text not in (printed := log.read_text()):
        assert time.monotonic() < end, printed
        time.sleep(0.1)
    return printed
