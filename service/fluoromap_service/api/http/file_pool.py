"""Processes that read uploaded files and draw pictures: a hostile or huge file cannot harm the service.

A decoder may crash, hang or take too much memory. Then only one process of this pool ends.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
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


_lock = threading.Lock()
_free = threading.BoundedSemaphore(PROCESSES)
_pool: ProcessPoolExecutor | None = None


def run_in_pool(
    task: Task, function: Callable[Arguments, Answer], *arguments: Arguments.args, **keywords: Arguments.kwargs
) -> Answer:  # fmt: skip
    """Call a function of a module in the pool and wait for its answer.

    Raises
    ------
    Problem
        422 ``undecodable`` when the function breaks its process, or exceeds the time or memory limit. 429 ``busy`` when
        too many requests wait for the pool. A ``Problem`` that the function raises passes unchanged.
    """
    # The time limit begins when a process is free, so that a request that waited long keeps its full time.
    if not _free.acquire(timeout=LONGEST_WAIT_SECONDS):
        raise _busy()
    try:
        for _ in range(2):
            pool = _running()
            try:
                return pool.submit(function, *arguments, **keywords).result(task.longest_seconds)
            except TimeoutError:
                _discard(pool)
                raise Problem(422, "undecodable", f"{task} takes too long; check the file.") from None
            except (BrokenProcessPool, CancelledError, RuntimeError):
                # Another request may have broken this pool: try once more, in a new pool.
                _discard(pool)
            except MemoryError:
                break
    finally:
        _free.release()
    detail = f"{task} breaks the decoder or needs more memory than the service allows; check the file."
    raise Problem(422, "undecodable", detail)


def start() -> None:
    """Start the processes ahead of the first request."""
    _running()


def close() -> None:
    """End the processes; the next request starts new ones."""
    with _lock:
        pool = _pool
    if pool is not None:
        _discard(pool)


def _running() -> ProcessPoolExecutor:
    global _pool
    with _lock:
        if _pool is None:
            # Not a plain fork: the API has threads, and a child would inherit their locks locked.
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(list(_PRELOADED))
            fresh = ProcessPoolExecutor(PROCESSES, context, _prepare_process, (settings().worker_memory_mib,))
            # Imports take seconds on a busy machine; the time limit of the first request begins after them.
            try:
                fresh.submit(_do_nothing).result(START_SECONDS)
            except TimeoutError:
                _kill(fresh)
                raise _busy() from None
            _pool = fresh
        return _pool


def _do_nothing() -> None:
    """Do nothing; a fresh pool answers this as soon as it can work."""


def _busy() -> Problem:
    detail = "The service is reading too many files and drawing too many pictures; send the request again."
    return Problem(429, "busy", detail, headers={"Retry-After": "5"})


def _discard(pool: ProcessPoolExecutor) -> None:
    global _pool
    with _lock:
        if _pool is pool:
            _pool = None
    _kill(pool)


def _kill(pool: ProcessPoolExecutor) -> None:
    for process in list((pool._processes or {}).values()):
        process.kill()
    pool.shutdown(wait=False, cancel_futures=True)


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
