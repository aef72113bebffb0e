"""The whole flow through command line and HTTP alone, on both stacks: embedded, and PostgreSQL with Redis.

Each runs a study undisturbed, and once more from nothing with the worker killed in the middle: the results must be the same.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from fluoromap.results import Client, inputs_of
from fluoromap.supervisor import free_port, program

PATIENCE_SECONDS = 240

pytestmark = pytest.mark.timeout(900)

Fresh = Callable[[], AbstractContextManager[str]]
Kill = Callable[[], None]
"""Kills the worker without warning and sees to it that there will be another."""


@contextmanager
def _process(*arguments: str, environment: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
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
            _kill_group(process.pid)


def _kill_group(pid: int) -> None:
    try:
        os.killpg(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


@contextmanager
def _embedded(environment: dict[str, str], port: int) -> Iterator[Kill]:
    """``fluoromap up``, which restarts its worker by itself."""
    with _process("up", "--port", str(port), environment=environment) as up:

        def kill() -> None:
            children = psutil.Process(up.pid).children()
            worker = next(child for child in children if "fluoromap worker" in " ".join(child.cmdline()))
            _kill_group(worker.pid)

        yield kill


@contextmanager
def _with_servers(environment: dict[str, str], port: int) -> Iterator[Kill]:
    """API and worker each by itself, as on many machines."""
    subprocess.run([program(), "db", "upgrade"], env=environment, check=True)
    with ExitStack() as stack:
        stack.enter_context(_process("api", "--port", str(port), environment=environment))
        worker = stack.enter_context(_process("worker", environment=environment))

        def kill() -> None:
            _kill_group(worker.pid)
            worker.wait()
            stack.enter_context(_process("worker", environment=environment))

        yield kill


def _environment(data_dir: Path, numba_cache: Path, **settings: str) -> dict[str, str]:
    data_dir.mkdir()
    environment = {key: value for key, value in os.environ.items() if not key.startswith("FLUOROMAP_")}
    environment.setdefault("NUMBA_CACHE_DIR", str(numba_cache))
    return environment | {
        "FLUOROMAP_DATA_DIR": str(data_dir),
        "FLUOROMAP_WORKERS": "2",
        "FLUOROMAP_LEASE_SECONDS": "3",
        "FLUOROMAP_HEARTBEAT_SECONDS": "1",
        "FLUOROMAP_REPUBLISH_SECONDS": "1",
        **settings,
    }


def _wait_until_ready(url: str, log_folder: Path) -> None:
    import httpx

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
    pytest.fail(f"the service did not get ready: {answer and answer.text}\n{logs}")


def _run_job(url: str, folder: Path, kill: Kill | None) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Send the study, run a job, kill the worker once while a run is being searched; the ended job and its points."""
    with Client(url) as client:
        study = client.make_study("stack")
        inputs = inputs_of(folder)
        assert [client.upload(study, path) for path in inputs.runs] == [[]] * len(inputs.runs)
        assert client.put_activation_times(study, inputs.activation_times) == []
        job: dict[str, Any] = {}
        for job in client.follow(client.start_job(study)):
            done = sum(row["state"] == "done" for row in job["stages"])
            if kill is not None and done and any(row["state"] == "running" for row in job["stages"]):
                kill()
                kill = None
        assert kill is None, "the job ended before the worker could be killed"
        return job, client.points(job["id"])


def _without_chance(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(points, key=lambda point: (point["site"], point["catheter"], point["electrode"]))


@pytest.mark.parametrize("stack", ["embedded", "servers"])
def test_a_killed_worker_changes_nothing(
    stack: str, simulated_study: Path, tmp_path: Path, fresh_postgres: Fresh, fresh_redis: Fresh
) -> None:
    results = []
    for disturbed in (False, True):
        data_dir = tmp_path / f"data-{disturbed}"
        with ExitStack() as opened:
            settings: dict[str, str] = {}
            if stack == "servers":
                settings["FLUOROMAP_DATABASE_URL"] = opened.enter_context(fresh_postgres())
                settings["FLUOROMAP_BROKER_URL"] = opened.enter_context(fresh_redis())
            environment = _environment(data_dir, simulated_study.parent / "numba", **settings)
            port = free_port()
            start = _embedded if stack == "embedded" else _with_servers
            kill = opened.enter_context(start(environment, port))
            url = f"http://127.0.0.1:{port}"
            _wait_until_ready(url, data_dir)
            results.append(_run_job(url, simulated_study, kill if disturbed else None))
    (undisturbed, points), (disturbed_job, disturbed_points) = results
    assert undisturbed["state"] == disturbed_job["state"] == "succeeded"
    assert max(row["attempt"] for row in undisturbed["stages"]) == 1
    assert max(row["attempt"] for row in disturbed_job["stages"]) > 1
    assert any(point["x_mm"] is not None for point in points)
    assert _without_chance(disturbed_points) == _without_chance(points)
