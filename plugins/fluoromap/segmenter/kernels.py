"""Kernels that a worker compiles before it takes work.

Numba compiles a kernel once a machine and keeps it in its cache. All of them take 10 s on one processor, most of it in Python.
So several processes share them: each takes a kernel that no other process is compiling, and then loads the others.
"""

from __future__ import annotations

import fcntl
import importlib
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numba import njit


@dataclass(frozen=True, slots=True)
class _Kernel:
    """A compiled function and the types of its arguments."""

    function: Any
    types: str

    @property
    def size(self) -> int:
        """Length of its byte code. The time to compile it rises with that."""
        return len(self.function.py_func.__code__.co_code)

    def compile(self) -> bool:
        """Compile the kernel or load it from the cache; return whether it was compiled."""
        missed = self.function.stats.cache_misses.total()
        self.function.compile(self.types)
        return bool(self.function.stats.cache_misses.total() > missed)

    def compile_alone(self, *, wait: bool) -> bool | None:
        """Compile or load the kernel while no other process does so.

        Return None where another process compiles it and ``wait`` is False; else see :meth:`compile`.
        """
        name = f"{self.function.py_func.__module__}.{self.function.py_func.__qualname__}.lock"
        folder = Path(self.function.stats.cache_path)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = (folder / name).open("w")
        except OSError:
            return self.compile()  # nobody can add to this cache
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except BlockingIOError:
                return None
            return self.compile()


_kernels: list[_Kernel] = []


def kernel(types: str, *, fastmath: bool = True) -> Callable[[Callable[..., Any]], Any]:
    """Make a function a kernel that :func:`compile_kernels` compiles.

    Parameters
    ----------
    types : str
        Types of the arguments in Numba's short form: ``f4[:,::1]`` is an array of float32 with rows in one piece of memory.
    fastmath : bool
        Whether sums may be formed in any order, and numbers are taken to be finite.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        compiled = njit(cache=True, nogil=True, fastmath=fastmath, error_model="numpy")(function)
        _kernels.append(_Kernel(compiled, f"({types},)"))
        return compiled

    return decorate


def compile_kernels() -> None:
    """Compile the kernels of all imported modules, or load them from the cache.

    Where the first one has to be compiled, a second process helps.
    """
    shortest, *others = sorted(_kernels, key=lambda each: each.size)
    helper = _start_helper() if shortest.compile_alone(wait=True) else None
    # The longest first, so that both processes end at nearly the same time.
    elsewhere = [each for each in reversed(others) if each.compile_alone(wait=False) is None]
    for each in elsewhere:
        each.compile_alone(wait=True)
    if helper is not None:
        helper.wait()


def _start_helper() -> subprocess.Popen[bytes] | None:
    modules = sorted({each.function.py_func.__module__ for each in _kernels})
    with suppress(OSError):
        return subprocess.Popen([sys.executable, "-P", "-m", __name__, *modules], stdin=subprocess.DEVNULL)
    return None


if __name__ == "__main__":
    for _module in sys.argv[1:]:
        importlib.import_module(_module)
    # This module has been imported by the others under its own name, with their kernels.
    importlib.import_module("fluoromap.segmenter.kernels").compile_kernels()
