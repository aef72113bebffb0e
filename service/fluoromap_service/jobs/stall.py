"""The recognition of a queue that nobody serves: stages are ready, and no stage of any job begins, lives or ends."""

from __future__ import annotations

import time
from collections.abc import Callable

from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from fluoromap_service.settings import settings
from fluoromap_service.store.models import Event, StageRow, StageState

SHORTEST_STALL_SECONDS = 20.0


def stall_seconds() -> float:
    """Return the silence after which ready stages count as stalled.

    A running stage writes an event with every heartbeat. Two of them must be missing.
    """
    return max(2 * settings().heartbeat_seconds, SHORTEST_STALL_SECONDS)


class StallWatch:
    """Watches the events of stages from look to look, by a clock that nobody can set."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        # No event has this id, so the first look begins the silence.
        self._newest: int | None = -1
        self._since = clock()

    def reset(self) -> None:
        """Begin anew: the silence until now has another cause."""
        self._since = self._clock()

    def look(self, session: Session) -> bool:
        """Return whether stages have been ready for ``stall_seconds`` while no stage changed."""
        now = self._clock()
        waiting = session.scalar(select(exists().where(StageRow.state == StageState.READY)))
        newest = session.scalar(select(Event.id).where(Event.kind == "stage").order_by(Event.id.desc()).limit(1))
        if not waiting or newest != self._newest:
            self._newest, self._since = newest, now
        return now - self._since > stall_seconds()
