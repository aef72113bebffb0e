"""The peer of a delivery of DICOM objects: it can be asked for an object, and sent one."""

from __future__ import annotations

from typing import Protocol

from fluoromap_service.api.results.result_objects import OutgoingObject
from fluoromap_service.deliveries.outbox import Failure


class NotDelivered(Exception):
    """An attempt that failed. No text of the peer is in it: that may name a patient."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.failure = Failure(code, detail)


def answer_too_long() -> NotDelivered:
    """Return the failure of a target that answers without end."""
    return NotDelivered("answer_too_long", "The target's answer is too long to be read; check its address.")


def answer_too_slow() -> NotDelivered:
    """Return the failure of a target whose answer does not end in time."""
    return NotDelivered(
        "answer_too_slow", "The target's answer did not end within its timeout_seconds; look at the target."
    )


class Peer(Protocol):
    """An open connection to a target."""

    def has(self, item: OutgoingObject) -> bool | None:
        """Return whether the peer has an object; None when it answers no such question."""

    def store(self, item: OutgoingObject) -> None:
        """Send an object.

        Raises
        ------
        NotDelivered
            When the peer did not confirm that it stored the object.
        """
