"""The header of a stored file in the DICOM JSON model (PS3.18 annex F), without pixels and other bulk data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, cast

from pydicom.dataelem import DataElement, RawDataElement
from pydicom.dataset import Dataset
from pydicom.filewriter import correct_ambiguous_vr_element
from pydicom.tag import BaseTag

from fluoromap_service.dicom.header import read_all_attributes
from fluoromap_service.dicom.inflation import open_dicom

Json = dict[str, Any]

LARGEST_VALUE_BYTES = 4096
"""Longer binary values are left out."""
DEEPEST_SEQUENCE = 16
"""Sequences within more sequences are left out."""
MOST_ELEMENTS = 200_000
"""Elements of one header, those of items included; further ones are left out. 1000 Enhanced frames have about 40 000."""
_BINARY = frozenset({"OB", "OD", "OF", "OL", "OV", "OW", "UN"})
_DELIMITER_GROUP = 0xFFFE
"""Group of the tags that begin and end items; outside a sequence they are a damage (PS3.5 section 7.5)."""


@dataclass(slots=True)
class JsonHeader:
    """A header in the DICOM JSON model, as far as it can be read.

    elements : the attributes. unreadable : tags of the attributes that were left out, with those of their sequences before
    them and dots between; "" where the header breaks off.
    """

    elements: Json
    unreadable: list[str]


def header_json(file: Path | IO[bytes]) -> Json:
    """Return the header of a file in the DICOM JSON model."""
    return read_json_header(file).elements


def read_json_header(file: Path | IO[bytes]) -> JsonHeader:
    """Read the header of a file into the DICOM JSON model.

    An attribute that cannot be read is left out, and the others stay.

    Raises
    ------
    Problem
        As :func:`fluoromap_service.dicom.header.read_header`, for damaged file meta information.
    """
    if isinstance(file, Path):
        with open_dicom(file) as opened:
            return _converted(*read_all_attributes(opened))
    return _converted(*read_all_attributes(cast(BufferedReader, file)))


def _converted(dataset: Dataset, is_whole: bool) -> JsonHeader:
    conversion = _Conversion([] if is_whole else [""])
    return JsonHeader(conversion.elements(dataset, "", 0), conversion.unreadable)


@dataclass(slots=True)
class _Conversion:
    """The conversion of one header: the attributes that were left out so far, and how many more may follow."""

    unreadable: list[str]
    elements_left: int = field(default=MOST_ELEMENTS)

    def elements(self, dataset: Dataset, path: str, depth: int) -> Json:
        """Return the attributes of a data set; ``path`` is that of its sequence."""
        shown: Json = {}
        for tag in sorted(dataset.keys()):
            self.elements_left -= 1
            name = f"{tag:08X}"
            if self.elements_left < 0:
                self.unreadable.append(path)
                break
            # The conversion of a damaged value raises nearly anything, from ValueError to struct.error.
            try:
                element = self._element(dataset, tag, f"{path}{name}", depth)
            except Exception:
                self.unreadable.append(f"{path}{name}")
            else:
                if element is not None:
                    shown[name] = element
        return shown

    def _element(self, dataset: Dataset, tag: BaseTag, path: str, depth: int) -> Json | None:
        """Return an attribute; None for bulk data."""
        if tag.group == _DELIMITER_GROUP:
            raise ValueError("a delimiter is no attribute")
        raw = dataset.get_item(tag)
        if isinstance(raw, RawDataElement) and raw.value is None and raw.length:
            return None
        element = dataset[tag]
        if element.VR == "SQ":
            if depth == DEEPEST_SEQUENCE:
                raise ValueError("too many sequences within sequences")
            return {"vr": "SQ", "Value": [self.elements(item, f"{path}.", depth + 1) for item in element.value]}
        if element.VR == "US or SS":
            element = cast(
                DataElement, correct_ambiguous_vr_element(element, dataset, bool(dataset.original_encoding[1]))
            )
        if " or " in element.VR:
            element = DataElement(tag, "UN", element.value)
        if element.VR in _BINARY and len(element.value or b"") > LARGEST_VALUE_BYTES:
            return None
        shown: Json = _plain(element.to_json_dict(bulk_data_element_handler=None, bulk_data_threshold=0))
        return shown


def _plain(value: Any) -> Any:
    """Return a value that every JSON parser reads.

    JSON has no number for NaN and infinity, so null takes their place (PS3.18 section F.2.5); UTF-8 has no half of a
    surrogate pair.
    """
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, int):
        return int(value)
    return None if value is None else str(value).encode("utf-8", "replace").decode()
