"""The sign that the API ends: answers that wait for a job end themselves, before their connections are cut."""

from __future__ import annotations

import threading

_stopping = threading.Event()


def begin() -> None:
    """Let waiting answers end. A signal handler may call it."""
    _stopping.set()


def begun() -> bool:
    """Return whether the API ends."""
    return _stopping.is_set()
