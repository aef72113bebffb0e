"""The header of a file as a search needs it: for its answer, and to compare its values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import msgspec

from fluoromap_service.dicom.facts import InstanceFacts
from fluoromap_service.dicom.json_model import JsonHeader, read_json_header
from fluoromap_service.dicom.matching import comparable_values
from fluoromap_service.dicom.reading import read_instance

Json = dict[str, Any]

LONGEST_ATTRIBUTE_BYTES = 16 * 2**10
"""Longer attributes are left out of the answer to a search; the metadata have them."""
LARGEST_HEADER_BYTES = 256 * 2**10
"""The stored header is not longer; 1000 Enhanced frames have ten times as much."""
MOST_VALUES = 1000
"""Values of one object that can be compared, from the first attribute on."""
DEEPEST_SEARCH = 4
"""Values in more sequences within sequences are not compared."""
_IMPORTANT = frozenset({"0008", "0010", "0020", "0028"})
"""Groups of the attributes that the answers to searches always have."""
PER_FRAME = "52009230"
"""The functional groups of each frame: too many values to compare."""


@dataclass(frozen=True, slots=True)
class IndexedValue:
    """A value of an attribute, for comparison.

    path : tag of the attribute, with those of its sequences before it and dots between; "" stands for the whole header.
    item : number of the item that holds it, counted over the header; 0 outside sequences. first, last : as
    :class:`fluoromap_service.dicom.matching.Comparable`; first is None where the value exists but cannot be compared.
    """

    path: str
    item: int
    first: str | None
    last: str | None


@dataclass(frozen=True, slots=True)
class IndexedHeader:
    """The header of an object as a search needs it.

    json : the header in the DICOM JSON model. is_whole : whether ``json`` has all that the metadata show. unreadable : number
    of attributes that could not be read. values : for comparison.
    """

    json: str
    is_whole: bool
    unreadable: int
    values: tuple[IndexedValue, ...]

    def first_value(self, tag: str) -> str:
        """Return the first value of an attribute that the header has, as text."""
        return str(msgspec.json.decode(self.json)[tag]["Value"][0])


@dataclass(frozen=True, slots=True)
class ReadRun:
    """A run as the doors read it: its facts, and its header for searches."""

    facts: InstanceFacts
    header: IndexedHeader


def read_run(path: Path) -> ReadRun:
    """Read and check one file for the store.

    Raises
    ------
    Problem, OSError
        As :func:`fluoromap_service.dicom.reading.read_instance`.
    """
    return ReadRun(read_instance(path), read_indexed(path))


def read_indexed(file: Path | IO[bytes]) -> IndexedHeader:
    """Read the header of a file for searches.

    Raises
    ------
    Problem, OSError
        As :func:`fluoromap_service.dicom.json_model.read_json_header`.
    """
    return indexed(read_json_header(file))


def indexed_facts(facts: InstanceFacts) -> IndexedHeader:
    """Return the header of a run whose file cannot be read.

    It has all that the facts have.
    """
    texts = {
        "00080016": ("UI", facts.sop_class_uid), "00080018": ("UI", facts.sop_instance_uid),
        "0020000D": ("UI", facts.study_instance_uid), "0020000E": ("UI", facts.series_instance_uid),
        "00280008": ("IS", facts.frames), "00280010": ("US", facts.rows), "00280011": ("US", facts.columns),
    }  # fmt: skip
    elements: Json = {tag: {"vr": vr, "Value": [value]} for tag, (vr, value) in texts.items()}
    return indexed(JsonHeader(elements, [""]), is_whole=False)


def metadata_of(path: Path) -> bytes:
    """Return the header of a file in the DICOM JSON model as UTF-8."""
    return msgspec.json.encode(read_json_header(path).elements)


def indexed(header: JsonHeader, is_whole: bool = True) -> IndexedHeader:
    """Return a header as searches need it.

    ``is_whole`` says whether it has all that the metadata show.
    """
    encoded = msgspec.json.encode(header.elements).decode()
    if len(encoded) > LARGEST_HEADER_BYTES:
        encoded, is_whole = _shortened(header.elements), False
    values = [*_values(header.elements), *(IndexedValue(path, 0, None, None) for path in header.unreadable)]
    if len(values) > MOST_VALUES:
        values = [*values[:MOST_VALUES], IndexedValue("", 0, None, None)]
    return IndexedHeader(encoded, is_whole, len(header.unreadable), tuple(values))


def _shortened(elements: Json) -> str:
    """Return the short attributes of a header as JSON, the most important ones first."""
    kept: dict[str, msgspec.Raw] = {}
    size = 0
    for tag, element in sorted(elements.items(), key=lambda item: (item[0][:4] not in _IMPORTANT, item[0])):
        raw = msgspec.json.encode(element)
        if len(raw) <= LONGEST_ATTRIBUTE_BYTES and size + len(raw) <= LARGEST_HEADER_BYTES:
            kept[tag] = msgspec.Raw(raw)
            size += len(raw)
    return msgspec.json.encode(kept).decode()


def _values(elements: Json) -> list[IndexedValue]:
    """Return the values of a header.

    Those outside sequences come first, then those of each deeper level.
    """
    found: list[IndexedValue] = []
    level = [("", 0, elements)]
    items = 0
    for _ in range(DEEPEST_SEARCH + 1):
        deeper = []
        for path, item, data_set in level:
            for tag, element in data_set.items():
                if element["vr"] != "SQ":
                    found += _values_of(f"{path}{tag}", item, tag, element)
                elif tag != PER_FRAME:
                    for nested in element.get("Value", ()):
                        items += 1
                        deeper.append((f"{path}{tag}.", items, nested))
        level = deeper
        if len(found) > MOST_VALUES:
            break
    return found


def _values_of(path: str, item: int, tag: str, element: Json) -> Iterator[IndexedValue]:
    for value in comparable_values(tag, element):
        yield IndexedValue(path, item, None if value is None else value.first, None if value is None else value.last)
