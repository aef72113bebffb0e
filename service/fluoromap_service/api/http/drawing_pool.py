"""Decoding and drawing for display in processes of their own: a hostile or huge frame harms nobody else."""

from __future__ import annotations

import multiprocessing
import resource
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import ParamSpec, TypeVar

from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

PROCESSES = 2
LONGEST_SECONDS = 20.0
START_SECONDS = 120.0
PATIENCE_SECONDS = 60.0

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")

_lock = threading.Lock()
_free = threading.BoundedSemaphore(PROCESSES)
_pool: ProcessPoolExecutor | None = None


def drawn(
    draw: Callable[Arguments, Answer], *arguments: Arguments.args, **keywords: Arguments.kwargs
) -> Answer:  # fmt: skip
    """Call a module's function in the pool and wait for its answer.

    Raises
    ------
    Problem
        422 ``undecodable`` (or the file's own code) when the frame cannot be decoded, not in time, or not within the
        memory allowed; 429 ``busy`` when too many pictures are being drawn.
    """
    # Time counts from the moment a process is free, so that a long queue is not taken for a slow frame.
    if not _free.acquire(timeout=PATIENCE_SECONDS):
        raise _busy()
    try:
        for _ in range(2):
            pool = _running()
            try:
                return pool.submit(draw, *arguments, **keywords).result(LONGEST_SECONDS)
            except TimeoutError:
                _discard(pool)
                raise Problem(422, "undecodable", "This frame takes too long to decode; check the file.") from None
            except (BrokenProcessPool, CancelledError, RuntimeError):
                # Perhaps another request's frame broke or ended the pool: once more, in a new one.
                _discard(pool)
            except MemoryError:
                break
    finally:
        _free.release()
    raise Problem(
        422, "undecodable", "This frame needs more memory than is allowed, or breaks the decoder; check the file."
    )


def start() -> None:
    """Start the processes ahead of the first picture."""
    _running()


def close() -> None:
    """End the processes; the next picture starts new ones."""
    with _lock:
        pool = _pool
    if pool is not None:
        _discard(pool)


def _running() -> ProcessPoolExecutor:
    global _pool
    with _lock:
        if _pool is None:
            # Not plain fork: the API has threads, whose locks a child would inherit locked.
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(
                ["fluoromap_service.api.results.overlays", "fluoromap_service.api.study.frames"]
            )
            fresh = ProcessPoolExecutor(PROCESSES, context, _limit_memory, (settings().worker_memory_mib,))
            # Imports take seconds on a busy machine; the first frame's time begins after them.
            try:
                fresh.submit(_started).result(START_SECONDS)
            except TimeoutError:
                _kill(fresh)
                raise _busy() from None
            _pool = fresh
        return _pool


def _started() -> None:
    """The first task of a fresh pool: answered as soon as a process can work."""


def _busy() -> Problem:
    return Problem(429, "busy", "Too many pictures are being drawn; ask again.", headers={"Retry-After": "5"})


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


def _limit_memory(mib: int) -> None:
    limit = mib * 2**20
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
