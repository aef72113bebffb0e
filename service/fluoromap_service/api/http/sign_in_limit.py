"""A limit on failed sign-ins, so that nobody can try tokens at speed."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict

from fluoromap_service.problem import Problem

MOST_FAILURES = 20
WINDOW_SECONDS = 60.0
_MOST_ADDRESSES = 10_000


class SignInLimit:
    """The failed sign-ins of each address in the last minute.

    An address with too many failures is refused, but a token that has been used from there before still works. So nobody
    can lock out the people behind the same proxy.
    """

    def __init__(self) -> None:
        self.failures = 0
        """All failures since the start."""
        self._recent: OrderedDict[str, list[float]] = OrderedDict()
        self._proven: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._lock = threading.Lock()

    def check(self, address: str, token: str) -> None:
        """Check that this address may try this token.

        Raises
        ------
        Problem
            429 ``too_many_failures`` when it has failed too often.
        """
        now = time.monotonic()
        with self._lock:
            recent = [moment for moment in self._recent.get(address, ()) if now - moment < WINDOW_SECONDS]
            if len(recent) < MOST_FAILURES or (address, token) in self._proven:
                return
            seconds = int(WINDOW_SECONDS - (now - recent[-MOST_FAILURES])) + 1
        raise Problem(
            429,
            "too_many_failures",
            "Too many wrong tokens came from this address; wait and send a valid one.",
            headers={"Retry-After": str(seconds)},
        )

    def failed(self, address: str) -> None:
        """Count a wrong token."""
        now = time.monotonic()
        with self._lock:
            self.failures += 1
            recent = [moment for moment in self._recent.pop(address, ()) if now - moment < WINDOW_SECONDS]
            self._recent[address] = [*recent, now][-MOST_FAILURES:]
            while len(self._recent) > _MOST_ADDRESSES:
                self._recent.popitem(last=False)

    def succeeded(self, address: str, token: str) -> None:
        """Remember that this token is valid from this address."""
        with self._lock:
            self._proven[address, token] = None
            self._proven.move_to_end((address, token))
            while len(self._proven) > _MOST_ADDRESSES:
                self._proven.popitem(last=False)
