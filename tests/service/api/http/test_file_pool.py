"""The file pool: a bad file ends one process of the pool and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path

import psutil
import pytest

from fluoromap_service.api.http import file_pool
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.problems import Problem
from fluoromap_service.dicom import DicomCode, dicom_problem


def _double(number: int) -> int:
    return 2 * number


def _die() -> None:
    os._exit(1)


def _refuse() -> None:
    raise dicom_problem(DicomCode.UNDECODABLE, "This frame is broken.", "PixelData")


def _read(path: Path) -> str:
    return path.read_text()


def _hang() -> None:
    time.sleep(600)


@pytest.fixture(scope="module", autouse=True)
def _processes(file_processes: None) -> None:
    assert run_in_pool(Task.DRAW_PICTURE, _double, 2) == 4


@pytest.mark.parametrize(
    ("task", "begin"), [(Task.READ_FILE, "Reading this file"), (Task.DRAW_PICTURE, "Drawing this")]
)
def test_a_file_that_kills_its_process_is_an_error_and_the_next_request_works(task: Task, begin: str) -> None:
    with pytest.raises(Problem) as problem:
        run_in_pool(task, _die)
    assert (problem.value.status, problem.value.code) == (422, "undecodable")
    assert problem.value.detail.startswith(begin)
    assert run_in_pool(task, _double, 21) == 42


def test_a_problem_of_the_file_passes() -> None:
    with pytest.raises(Problem) as problem:
        run_in_pool(Task.DRAW_PICTURE, _refuse)
    assert (problem.value.status, problem.value.errors[0][0]) == (422, "PixelData")


@pytest.mark.parametrize(
    ("task", "begin"), [(Task.READ_FILE, "Reading this file"), (Task.DRAW_PICTURE, "Drawing this")]
)
def test_a_function_that_hangs_is_stopped(monkeypatch: pytest.MonkeyPatch, task: Task, begin: str) -> None:
    monkeypatch.setattr(file_pool, "LONGEST_SECONDS", 0.2)
    with pytest.raises(Problem) as problem:
        run_in_pool(task, _hang)
    assert (problem.value.status, problem.value.code) == (503, "too_slow")
    assert int(problem.value.headers["Retry-After"]) > 0
    assert problem.value.detail.startswith(f"{task} did not end within 0.2 s")
    assert "check the file" not in problem.value.detail
    assert problem.value.detail.startswith(begin)
    monkeypatch.undo()
    assert run_in_pool(task, _double, 1) == 2


def test_a_task_that_never_ends_takes_no_other_task_with_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The good task begins before the other one is killed, and ends after it."""
    monkeypatch.setattr(file_pool, "LONGEST_SEARCH_SECONDS", 1.0)
    monkeypatch.setattr(file_pool, "LONGEST_SECONDS", 120.0)
    begun, allowed = tmp_path / "begun", tmp_path / "allowed"
    with ThreadPoolExecutor(2) as threads:
        good = threads.submit(run_in_pool, Task.READ_FILE, _wait_for, begun, allowed)
        while not begun.exists():
            time.sleep(0.01)
        for _ in range(2):
            with pytest.raises(Problem, match="did not end within 1 s"):
                run_in_pool(Task.FIND_ELECTRODES, _hang)
            assert run_in_pool(Task.DRAW_PICTURE, _double, 3) == 6
        assert not good.done()
        allowed.touch()
        pid = good.result()
    assert psutil.pid_exists(pid)


def _wait_for(begun: Path, allowed: Path) -> int:
    begun.touch()
    while not allowed.exists():
        time.sleep(0.01)
    return os.getpid()


def test_the_processes_end_with_a_killed_service(tmp_path: Path) -> None:
    """Nothing closes the pool of a service that is killed."""
    program = (
        "import os\n"
        "from fluoromap_service.api.http import file_pool\n"
        "if __name__ == '__main__':\n"
        "    file_pool.run_in_pool(file_pool.Task.DRAW_PICTURE, os.getpid)\n"
        "    print(flush=True)\n"
        "    input()\n"
    )
    script = tmp_path / "service.py"
    script.write_text(program)
    service = subprocess.Popen([sys.executable, script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert service.stdout is not None
    service.stdout.readline()
    processes = psutil.Process(service.pid).children(recursive=True)
    assert len(processes) >= 2
    service.kill()
    service.wait()
    _, alive = psutil.wait_procs(processes, timeout=60)
    assert alive == []


def test_searches_leave_a_process_to_other_requests(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with ThreadPoolExecutor(2) as threads:
        # Each search lasts until somebody has written to the pipe.
        searches = [threads.submit(run_in_pool, Task.FIND_ELECTRODES, _read, pipe) for _ in range(2)]
        with pipe.open("w"):
            picture = run_in_pool(Task.DRAW_PICTURE, _double, 2)
            assert not any(search.done() for search in searches)
        # Else the first search may take this for its own end.
        wait(searches, return_when=FIRST_COMPLETED)
        pipe.write_text("")
        assert [picture, *(search.result() for search in searches)] == [4, "", ""]
