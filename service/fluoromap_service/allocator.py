"""How the C library of a process handles freed memory."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_ARENA_MAX, _MMAP_THRESHOLD, _TRIM_THRESHOLD = -8, -3, -1
"""Numbers of the options in <malloc.h>."""
_KEPT_BYTES = 32 << 20
"""More than a picture needs; the C library accepts no larger M_MMAP_THRESHOLD."""


def return_freed_memory() -> None:
    """Let the C library give freed memory back to the system.

    Call it before the first thread starts: by default each thread keeps the memory of its largest answer. C libraries without these
    options decide by themselves.
    """
    _set({_ARENA_MAX: 2, _MMAP_THRESHOLD: 1 << 20, _TRIM_THRESHOLD: 4 << 20})


def keep_freed_memory() -> None:
    """Let the C library keep freed memory, in one place for all threads.

    For a process that repeats similar tasks: the system clears each new page before the process gets it.
    """
    _set({_ARENA_MAX: 1, _MMAP_THRESHOLD: _KEPT_BYTES, _TRIM_THRESHOLD: _KEPT_BYTES})


def _set(options: dict[int, int]) -> None:
    with suppress(AttributeError, OSError):
        for option, value in options.items():
            ctypes.CDLL(None).mallopt(option, value)
