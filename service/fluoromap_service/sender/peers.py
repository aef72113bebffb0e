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
