"""The peer of a delivery of DICOM objects: it can be asked for an object, and sent one."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Protocol

import pydicom

from fluoromap_service.deliveries.outbox import Failure


class NotDelivered(Exception):
    """An attempt that failed. No text of the peer is in it: that may name a patient."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.failure = Failure(code, detail)


@dataclass(frozen=True, slots=True)
class ResultObject:
    """A DICOM file with the UIDs by which a peer knows it."""

    name: str
    content: bytes
    sop_class_uid: str
    study_instance_uid: str
    series_instance_uid: str
    sop_instance_uid: str

    @classmethod
    def of_file(cls, name: str, content: bytes) -> ResultObject:
        """Read the UIDs of a DICOM file."""
        keywords = ["SOPClassUID", "StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID"]
        header = pydicom.dcmread(io.BytesIO(content), stop_before_pixels=True, specific_tags=list(keywords))
        return cls(name, content, *(str(header[keyword].value) for keyword in keywords))


class Peer(Protocol):
    """An open connection to a target."""

    def has(self, item: ResultObject) -> bool | None:
        """Return whether the peer has an object; None when it answers no such question."""

    def store(self, item: ResultObject) -> None:
        """Send an object.

        Raises
        ------
        NotDelivered
            When the peer did not confirm that it stored the object.
        """
