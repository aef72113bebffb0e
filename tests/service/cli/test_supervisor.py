"""The supervisor, with small programs instead of the API and the worker."""

from __future__ import annotations

import functools
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import psutil
import pytest

from fluoromap_service.cli import supervisor
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.folder_lock import only_one
from fluoromap_service.cli.supervisor import Supervisor, check_port, free_port

PROGRAM = """#!/bin/sh
echo $$ >> "$FLUOROMAP_DATA_DIR/$1.pids"
if [ -e "$FLUOROMAP_DATA_DIR/$1.broken" ]; then exit 3; fi
sleep 600 &
wait
"""


@pytest.fixture
def running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Supervisor]:
    script = tmp_path / "fluoromap"
    script.write_text(PROGRAM)
    script.chmod(0o755)
    monkeypatch.setattr(supervisor, "program", lambda: str(script))
    environment = os.environ | {"FLUOROMAP_DATA_DIR": str(tmp_path)}
    started = Supervisor("127.0.0.1", free_port(), environment, log_folder=tmp_path)
    started.start()
    yield started
    started.stop()


def _eventually(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def _pids(folder: Path, name: str) -> list[int]:
    note = folder / f"{name}.pids"
    return [int(line) for line in note.read_text().split()] if note.exists() else []


def _gone(pid: int) -> bool:
    return not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def test_dead_worker_is_replaced_and_its_children_are_not_left(running: Supervisor, tmp_path: Path) -> None:
    _eventually(lambda: bool(_pids(tmp_path, "worker")))
    first = _pids(tmp_path, "worker")[0]
    _eventually(lambda: bool(psutil.Process(first).children()))
    child = psutil.Process(first).children()[0].pid
    os.kill(first, signal.SIGKILL)

    def replaced() -> bool:
        running.check_children()
        return len(_pids(tmp_path, "worker")) == 2

    _eventually(replaced)
    _eventually(lambda: _gone(child))


def test_worker_that_keeps_dying_is_restarted_ever_later(running: Supervisor, tmp_path: Path) -> None:
    (tmp_path / "worker.broken").touch()
    _eventually(lambda: bool(_pids(tmp_path, "worker")))
    os.killpg(_pids(tmp_path, "worker")[0], signal.SIGKILL)
    waits = set()

    def thrice() -> bool:
        running.check_children()
        child = running._worker
        if child.restart_at is not None:
            waits.add(child.deaths)
        return child.deaths >= 3

    _eventually(thrice)
    assert len(_pids(tmp_path, "worker")) == 3


def test_dead_api_is_an_error_that_says_where_to_look(running: Supervisor, tmp_path: Path) -> None:
    _eventually(lambda: bool(_pids(tmp_path, "api")))
    os.killpg(_pids(tmp_path, "api")[0], signal.SIGKILL)

    def reported() -> bool:
        try:
            running.check_children()
        except CommandFailed as error:
            return str(tmp_path) in str(error)
        return False

    _eventually(reported)


def test_api_that_dies_after_the_service_was_ready_is_replaced(running: Supervisor, tmp_path: Path) -> None:
    _eventually(lambda: bool(_pids(tmp_path, "api")))
    running._was_ready = True
    os.killpg(_pids(tmp_path, "api")[0], signal.SIGKILL)

    def replaced() -> bool:
        running.check_children()
        return len(_pids(tmp_path, "api")) == 2

    _eventually(replaced)


def test_worker_without_a_sign_of_life_is_killed_and_replaced(
    running: Supervisor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks = [{"name": "database", "ok": True}, {"name": "worker", "ok": False}]
    transport = httpx.MockTransport(lambda request: httpx.Response(503, json={"checks": checks}))
    client = functools.partial(httpx.Client, transport=transport)
    monkeypatch.setattr(supervisor.httpx, "Client", client)
    _eventually(lambda: bool(_pids(tmp_path, "worker")))
    running.check_service()
    # A young worker still starts.
    assert not _gone(_pids(tmp_path, "worker")[0])
    monkeypatch.setattr(supervisor, "STEADY_SECONDS", 0.0)
    running._next_look = 0.0
    running.check_service()
    assert _gone(_pids(tmp_path, "worker")[0])

    def replaced() -> bool:
        running.check_children()
        return len(_pids(tmp_path, "worker")) == 2

    _eventually(replaced)


def test_api_that_gives_no_answer_is_killed(
    running: Supervisor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "STEADY_SECONDS", 0.0)
    monkeypatch.setattr(supervisor, "SILENT_SECONDS", 0.0)
    _eventually(lambda: bool(_pids(tmp_path, "api")))
    running.check_service()
    assert _gone(_pids(tmp_path, "api")[0])
    assert not _gone(_pids(tmp_path, "worker")[0])


def test_one_service_a_folder(tmp_path: Path) -> None:
    with only_one(tmp_path / "data"):
        with pytest.raises(CommandFailed, match=f"process {os.getpid()}"), only_one(tmp_path / "data"):
            pass
        with only_one(tmp_path / "other"):
            pass
    with only_one(tmp_path / "data"):
        pass


CHILD = "from fluoromap_service.parent_process import end_with_parent as f; f({}); print('ready', flush=True); input()"


def test_child_ends_with_its_killed_parent() -> None:
    child = CHILD.format("__import__('os').getppid()")
    parent = subprocess.Popen(
        [sys.executable, "-c", f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"ready\n"
    (started,) = psutil.Process(parent.pid).children()
    parent.kill()
    parent.wait()
    _eventually(lambda: _gone(started.pid))


def test_child_whose_parent_has_ended_ends_at_once() -> None:
    answer = subprocess.run(
        [sys.executable, "-c", CHILD.format("1 << 30")], stdin=subprocess.DEVNULL, capture_output=True
    )
    assert (answer.returncode, answer.stdout) == (1, b"")


def test_stop_leaves_nothing_running(running: Supervisor, tmp_path: Path) -> None:
    _eventually(lambda: bool(_pids(tmp_path, "api")) and bool(_pids(tmp_path, "worker")))
    pids = _pids(tmp_path, "api") + _pids(tmp_path, "worker")
    running.stop()
    assert all(_gone(pid) for pid in pids)


def test_taken_port_is_refused_before_anything_starts() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(CommandFailed, match="--port"):
            check_port("127.0.0.1", taken.getsockname()[1])


def test_program_is_the_one_of_this_environment() -> None:
    answer = subprocess.run([supervisor.program(), "--help"], capture_output=True, text=True, check=True)
    assert "simulate" in answer.stdout
