"""Faults of processes and plugins, against the running program."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from faulty import faulty_plugins
from processes import PATIENCE_SECONDS, environment_of, process, wait_until_ready

from fluoromap_service.cli.client import Client
from fluoromap_service.cli.own_token import read_token
from fluoromap_service.cli.submission import find_files
from fluoromap_service.cli.supervisor import free_port, program

TOP = Path(__file__).parents[2]

pytestmark = pytest.mark.timeout(900)


class Service:
    """A running ``fluoromap up`` with the faulty plugins, and a study in it."""

    def __init__(self, up: subprocess.Popen[bytes], url: str, environment: dict[str, str], folder: Path) -> None:
        self.up, self.url, self.environment = up, url, environment
        self.token = read_token(self.data_dir)
        with Client(url, self.token) as client:
            self.study = client.make_study("faults")
            inputs = find_files(folder)
            assert not any(client.upload(self.study, path).objections for path in inputs.runs)
            assert inputs.activation_times is not None
            client.put_activation_times(self.study, inputs.activation_times)

    @property
    def data_dir(self) -> Path:
        return Path(self.environment["FLUOROMAP_DATA_DIR"])

    def child(self, name: str) -> psutil.Process:
        """Return the API or the worker."""
        children = psutil.Process(self.up.pid).children()
        return next(child for child in children if f"fluoromap {name}" in " ".join(child.cmdline()))

    def stage_processes(self) -> list[psutil.Process]:
        (server,) = (
            child for child in self.child("worker").children() if "pool_child" in " ".join(child.cmdline())
        )  # fmt: skip
        return server.children()

    def start_job(self, segmenter: str = "catheter-chain", **params: Any) -> str:
        with Client(self.url, self.token) as client:
            return client.start_job(self.study, {"pipeline": {"segmenter": {"name": segmenter, "params": params}}})

    def job(self, job: str) -> dict[str, Any]:
        answer: dict[str, Any] = self.ask("GET", f"/v1/jobs/{job}").json()
        return answer

    def ask(self, method: str, path: str) -> httpx.Response:
        return httpx.request(method, f"{self.url}{path}", headers=self.headers)

    @property
    def headers(self) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.token}"}

    def ended(self, job: str) -> dict[str, Any]:
        until(lambda: self.job(job)["state"] in ("succeeded", "failed", "cancelled"))
        return self.job(job)

    def until_running(self, job: str) -> None:
        until(lambda: any(stage["state"] == "running" for stage in self.job(job)["stages"]))


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_SECONDS
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def gone(member: psutil.Process) -> bool:
    try:
        return not member.is_running() or member.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, simulated_study: Path) -> Iterator[Service]:
    """The running service, shared by the tests of this module."""
    folder = tmp_path_factory.mktemp("faults")
    faulty_plugins.install(folder)
    environment = environment_of(folder / "data")
    paths = (str(folder), str(Path(faulty_plugins.__file__).parent), os.environ.get("PYTHONPATH", ""))
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    port = free_port()
    with process("up", "--port", str(port), environment=environment) as up:
        url = f"http://127.0.0.1:{port}"
        wait_until_ready(url, folder / "data")
        yield Service(up, url, environment, simulated_study)


def test_a_cancelled_job_ends_although_its_plugin_hangs(service: Service) -> None:
    for segmenter, params in (("hangs", {}), ("holds-lock", {"seconds": 3600})):
        job = service.start_job(segmenter, **params)
        service.until_running(job)
        begin = time.monotonic()
        assert service.ask("POST", f"/v1/jobs/{job}:cancel").status_code == 202
        ended = service.ended(job)
        print(f"{segmenter}: cancelled after {time.monotonic() - begin:.1f} s")
        assert ended["state"] == "cancelled"
        assert max(stage["attempt"] for stage in ended["stages"]) == 1
    # The processes that the plugins have blocked are replaced.
    assert service.ended(service.start_job())["state"] == "succeeded"


def test_a_plugin_that_blocks_its_process_past_the_lease_keeps_its_claim(service: Service) -> None:
    lease_seconds = int(service.environment["FLUOROMAP_LEASE_SECONDS"])
    ended = service.ended(service.start_job("holds-lock", seconds=2 * lease_seconds))
    assert ended["state"] == "succeeded"
    assert {stage["attempt"] for stage in ended["stages"]} == {1}


def test_a_plugin_that_returns_nothing_fails_in_its_own_stage(service: Service) -> None:
    ended = service.ended(service.start_job("returns-none"))
    assert ended["state"] == "failed"
    failed = [stage for stage in ended["stages"] if stage["state"] == "failed"]
    assert {stage["name"] for stage in failed} == {"segment"}
    for stage in failed:
        assert stage["error"]["code"] == "plugin_failed"
        assert "returns-none returned NoneType, expected Segmentation" in stage["error"]["detail"]


def test_the_death_of_idle_processes_blocks_no_other(service: Service) -> None:
    """Once they shared a lock. The process that was killed while it held the lock blocked all others for ever."""
    assert service.ended(service.start_job("holds-lock", seconds=0))["state"] == "succeeded"
    worker = service.child("worker").pid
    for member in service.stage_processes():
        member.kill()
    assert service.ended(service.start_job("holds-lock", seconds=1))["state"] == "succeeded"
    assert service.child("worker").pid == worker


def test_a_message_that_is_none_does_not_end_the_worker(service: Service) -> None:
    worker = service.child("worker").pid
    messages = service.data_dir / "queue" / "messages"
    for number, content in enumerate((b"no JSON", b"[]", b'{"body": 1}', b"\xff\xfe")):
        (messages / f"0_{number}.celery.msg").write_bytes(content)
    until(lambda: not list(messages.glob("0_*")))
    assert service.ended(service.start_job())["state"] == "succeeded"
    assert service.child("worker").pid == worker


def test_a_second_service_on_the_folder_is_refused(service: Service) -> None:
    second = subprocess.run(
        [program(), "up", "--port", str(free_port())], env=service.environment, capture_output=True, text=True
    )
    assert second.returncode == 1
    assert str(service.up.pid) in second.stderr


def test_a_dead_api_is_started_again(service: Service) -> None:
    api = service.child("api")
    api.kill()
    until(lambda: gone(api))
    wait_until_ready(service.url, service.data_dir)
    assert service.child("api").pid != api.pid


def test_event_streams_end_cleanly_when_the_api_ends(service: Service) -> None:
    job = service.start_job("hangs")
    service.until_running(job)
    api = service.child("api")
    with httpx.stream("GET", f"{service.url}/v1/jobs/{job}/events", headers=service.headers, timeout=60) as stream:
        lines = stream.iter_lines()
        assert next(lines).startswith("event:")
        api.terminate()
        # A stream that is cut raises an error here.
        assert list(lines)
    # Its streams end before it stops to answer: the next answers could still be its own.
    until(lambda: gone(api))
    wait_until_ready(service.url, service.data_dir)
    service.ask("POST", f"/v1/jobs/{job}:cancel")
    assert service.ended(job)["state"] == "cancelled"


def test_a_worker_that_must_end_gives_its_stages_back(service: Service) -> None:
    """It waits for them for a limited time."""
    job = service.start_job("hangs")
    service.until_running(job)
    worker = service.child("worker")
    members = [worker, *worker.children(recursive=True)]
    worker.terminate()
    until(lambda: all(gone(member) for member in members))
    stages = service.job(job)["stages"]
    # The next worker may have taken the stage already.
    assert any((stage["state"], stage["attempt"]) == ("ready", 1) or stage["attempt"] == 2 for stage in stages)
    service.ask("POST", f"/v1/jobs/{job}:cancel")
    assert service.ended(job)["state"] == "cancelled"


def test_all_processes_end_with_a_killed_service(service: Service) -> None:
    """It ends the shared service, so it is the last test of it."""
    members = psutil.Process(service.up.pid).children(recursive=True)
    assert len(members) >= 5
    os.kill(service.up.pid, signal.SIGKILL)
    until(lambda: all(gone(member) for member in members))
    port = free_port()
    with process("up", "--port", str(port), environment=service.environment):
        wait_until_ready(f"http://127.0.0.1:{port}", service.data_dir)


@pytest.mark.parametrize("stack", ["embedded", "servers"])
def test_a_short_campaign_of_faults_changes_nothing(stack: str) -> None:
    command = [sys.executable, str(TOP / "benchmarks" / "fault_campaign.py")]
    options = ["--stack", stack, "--faults", "6", "--each-round", "6", "--seed", "11"]
    campaign = subprocess.run([*command, *options], capture_output=True, text=True)
    print(campaign.stdout)
    assert campaign.returncode == 0, campaign.stdout + campaign.stderr
