"""The origins of coordinates that a reader can choose."""

from __future__ import annotations

from enum import StrEnum


class Origin(StrEnum):
    """Origin of coordinates; the axes are always DICOM patient axes (LPS)."""

    REFERENCE = "reference"
    ISOCENTRE = "isocentre"
