"""The header of a stored file in the DICOM JSON model (PS3.18 annex F), without pixels and other bulk data."""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

import pydicom

Json = dict[str, Any]

LARGEST_VALUE_BYTES = 4096
"""Longer binary values are left out."""
_BINARY = frozenset({"OB", "OD", "OF", "OL", "OV", "OW", "UN"})


def header_json(file: Path | IO[bytes]) -> Json:
    """Return the header of a file in the DICOM JSON model."""
    header = pydicom.dcmread(file, stop_before_pixels=True)
    for element in list(header):
        if element.VR in _BINARY and len(element.value or b"") > LARGEST_VALUE_BYTES:
            del header[element.tag]
    answer: Json = header.to_json_dict(suppress_invalid_tags=True, bulk_data_element_handler=None)
    return answer
