"""The end of a worker: it takes no new stage, and the running stages get a limited time."""

from __future__ import annotations

import time

from fluoromap_service.jobs.queue import DRAIN_SECONDS


class Drain:
    """The state of a worker's end. :meth:`begin` may be called from a signal handler."""

    def __init__(self) -> None:
        self._end = float("inf")

    def begin(self) -> None:
        """Take no new stage from now on."""
        self._end = min(self._end, time.monotonic() + DRAIN_SECONDS)

    @property
    def begun(self) -> bool:
        """Whether the worker must take no new stage."""
        return self._end != float("inf")

    @property
    def over(self) -> bool:
        """Whether the running stages have had their time."""
        return time.monotonic() > self._end
