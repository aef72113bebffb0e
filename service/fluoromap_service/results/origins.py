"""The origins of coordinates that a reader can choose."""

from __future__ import annotations

from enum import StrEnum

from fluoromap_service.store.models import Job


class Origin(StrEnum):
    """Origin of coordinates; the axes are always DICOM patient axes (LPS)."""

    REFERENCE = "reference"
    ISOCENTRE = "isocentre"


def origin_in(job: Job, chosen: Origin) -> Origin:
    """Return the origin of a job's positions: the chosen one, or the isocentre.

    Positions of a study without a reference catheter always count from the isocentre.
    """
    return Origin.ISOCENTRE if job.snapshot["reference"] is None else chosen
