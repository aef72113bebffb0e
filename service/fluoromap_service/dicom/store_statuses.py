"""The DICOM statuses of C-STORE, which are the failure reasons of STOW-RS too (PS3.4 table B.2-1, PS3.7 annex C)."""

from __future__ import annotations

from enum import IntEnum

from fluoromap_service.dicom.errors import DicomCode
from fluoromap_service.problem import Problem


class StoreStatus(IntEnum):
    """Statuses of C-STORE; the comment of an answer (0000,0902) is the stable code of the problem."""

    SUCCESS = 0x0000
    """The object is stored, or was stored already with the same data set."""
    PROCESSING_FAILURE = 0x0110
    """A fault of the service; the log of the listener has it."""
    OUT_OF_RESOURCES = 0xA700
    """The disk is full, the object is too large, or the service is busy; the sender may try again later."""
    NOT_OF_THIS_CLASS = 0xA900
    """The data set is no X-ray run, or its UIDs differ from those of the command."""
    CANNOT_UNDERSTAND = 0xC000
    """The data set is damaged, truncated, or has pixels that the service cannot decode."""
    OTHER_CONTENT = 0xC001
    """The store has another data set under the same SOP Instance UID."""


def status_of(problem: Problem) -> StoreStatus:
    """Return the status for a problem of a file."""
    if problem.code == "sop_instance_uid_taken":
        return StoreStatus.OTHER_CONTENT
    if problem.code == DicomCode.NOT_XA:
        return StoreStatus.NOT_OF_THIS_CLASS
    if problem.status in (413, 429, 503, 507):
        return StoreStatus.OUT_OF_RESOURCES
    return StoreStatus.CANNOT_UNDERSTAND
