"""Processes that read uploaded files and draw pictures: a hostile or huge file cannot harm the service.

A decoder may crash, hang or take too much memory. Then one process ends with its one task, and the others go on.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import resource
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from enum import StrEnum
from typing import ParamSpec, TypeVar

from fluoromap.drawing.warm_up import warm_up as draw_first_picture
from fluoromap_service.allocator import keep_freed_memory
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

PROCESSES = 2
LONGEST_SECONDS = 20.0
LONGEST_SEARCH_SECONDS = 90.0
"""The first search of a process compiles its kernels."""
START_SECONDS = 120.0
LONGEST_WAIT_SECONDS = 60.0
SLOW_RETRY_SECONDS = 30
"""When a client may repeat a task that took too long: other requests have had the process meanwhile."""
_PRELOADED = ("fluoromap_service.dicom", "fluoromap_service.results.fusion")

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")


class Task(StrEnum):
    """The task that a request gives to the pool, as its error messages name it."""

    READ_FILE = "Reading this file"
    DRAW_PICTURE = "Drawing this picture"
    WRITE_DICOM = "Writing the results as DICOM"
    FIND_ELECTRODES = "Finding the electrodes of this frame"

    @property
    def longest_seconds(self) -> float:
        """Time limit of the task."""
        return LONGEST_SEARCH_SECONDS if self is Task.FIND_ELECTRODES else LONGEST_SECONDS


class _PoolProcess:
    """One process of the pool, with one task at a time: when it is killed, only this task ends."""

    def __init__(self) -> None:
        self._executor: ProcessPoolExecutor | None = None

    def start(self) -> ProcessPoolExecutor:
        """Return the running process; start it first where there is none.

        Raises
        ------
        Problem
            429 ``busy`` when the process does not start in time.
        """
        if self._executor is None:
            # Not a plain fork: the API has threads, and a child would inherit their locks locked.
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(list(_PRELOADED))
            fresh = ProcessPoolExecutor(1, context, _prepare_process, (settings().worker_memory_mib,))
            # Imports take seconds on a busy machine; the time limit of the first request begins after them.
            try:
                fresh.submit(_do_nothing).result(START_SECONDS)
            except TimeoutError:
                _kill(fresh)
                raise _busy() from None
            self._executor = fresh
        return self._executor

    def end(self) -> None:
        """Kill the process; the next task starts another one."""
        executor, self._executor = self._executor, None
        if executor is not None:
            _kill(executor)


_processes = tuple(_PoolProcess() for _ in range(PROCESSES))
_idle: queue.LifoQueue[_PoolProcess] = queue.LifoQueue()
"""The processes without a task. The latest to end one comes first: its kernels are compiled."""
for _process in _processes:
    _idle.put(_process)


_free_for_searches = threading.BoundedSemaphore(PROCESSES - 1)
"""Searches take long: a process remains for uploads and pictures."""


def run_in_pool(
    task: Task, function: Callable[Arguments, Answer], *arguments: Arguments.args, **keywords: Arguments.kwargs
) -> Answer:  # fmt: skip
    """Call a function of a module in the pool and wait for it.

    Raises
    ------
    Problem
        422 ``undecodable`` when the function breaks its process or exceeds the memory limit. 503 ``too_slow`` when it exceeds the
        time limit. 429 ``busy`` when too many requests wait for the pool. A ``Problem`` that the function raises passes unchanged.
    """
    if task is not Task.FIND_ELECTRODES:
        return _run_when_free(task, function, *arguments, **keywords)
    if not _free_for_searches.acquire(timeout=LONGEST_WAIT_SECONDS):
        raise _busy()
    try:
        return _run_when_free(task, function, *arguments, **keywords)
    finally:
        _free_for_searches.release()


def _run_when_free(
    task: Task, function: Callable[Arguments, Answer], *arguments: Arguments.args, **keywords: Arguments.kwargs
) -> Answer:  # fmt: skip
    # The time limit begins when a process is free, so that a request that waited long keeps its full time.
    try:
        process = _idle.get(timeout=LONGEST_WAIT_SECONDS)
    except queue.Empty:
        raise _busy() from None
    try:
        for _ in range(2):
            executor = process.start()
            try:
                return executor.submit(function, *arguments, **keywords).result(task.longest_seconds)
            except TimeoutError:
                process.end()
                raise _too_slow(task) from None
            except (BrokenProcessPool, CancelledError, RuntimeError):
                # The process may have died while it had no task: try once more, in a new one.
                process.end()
            except MemoryError:
                break
    finally:
        _idle.put(process)
    detail = f"{task} breaks the decoder or needs more memory than the service allows; check the file."
    raise Problem(422, "undecodable", detail)


def start() -> None:
    """Start a process ahead of the first request."""
    with suppress(queue.Empty):
        process = _idle.get_nowait()
        try:
            process.start()
        finally:
            _idle.put(process)


def close() -> None:
    """End the processes; the next request starts new ones."""
    for process in _processes:
        process.end()


def _do_nothing() -> None:
    """Do nothing; a fresh process answers this as soon as it can work."""


def _busy() -> Problem:
    detail = "The service is reading too many files and drawing too many pictures; send the request again."
    return Problem(429, "busy", detail, headers={"Retry-After": "5"})


def _too_slow(task: Task) -> Problem:
    detail = (
        f"{task} did not end within {task.longest_seconds:g} s, so the service stopped it; the file may be whole. Send the "
        "request again when the service has less to do."
    )
    return Problem(503, "too_slow", detail, headers={"Retry-After": str(SLOW_RETRY_SECONDS)})


def _kill(executor: ProcessPoolExecutor) -> None:
    for process in list((executor._processes or {}).values()):
        process.kill()
    executor.shutdown(wait=False, cancel_futures=True)


def _prepare_process(mib: int) -> None:
    _limit_memory(mib)
    keep_freed_memory()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Beside the first task, which may be the upload of a run.
    threading.Thread(target=draw_first_picture, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the service has ended, however it ended."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _limit_memory(mib: int) -> None:
    limit = mib * 2**20
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
