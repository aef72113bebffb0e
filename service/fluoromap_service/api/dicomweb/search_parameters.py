"""The parameters of a QIDO-RS search (PS3.18 section 8.3.4)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from pydicom.datadict import tag_for_keyword

from fluoromap_service.dicom.indexed_header import DEEPEST_SEARCH, PER_FRAME
from fluoromap_service.dicom.matching import BINARY, representation_of
from fluoromap_service.problem import Problem

DEFAULT_LIMIT, MOST_RESULTS = 100, 500
MOST_KEYS = 100
"""A search with more attributes to match is refused."""
_COMPUTED = frozenset(
    {
        "00080054", "00081190",
        "00201200", "00201202", "00201204", "00201206", "00201208", "00201209",
    }
)  # fmt: skip
"""RetrieveAETitle, RetrieveURL and the numbers of related objects: the service computes them, and no header has them."""


@dataclass(frozen=True, slots=True)
class Key:
    """An attribute to match.

    name : as the request has it. path : tag of the attribute, with those of its sequences before it and dots between.
    text : the wanted value; "" matches any.
    """

    name: str
    path: str
    text: str

    @property
    def tag(self) -> str:
        """Tag of the attribute itself."""
        return self.path.rpartition(".")[2]

    @property
    def is_universal(self) -> bool:
        """Whether every object matches, also one without the attribute."""
        return not self.text.strip("* \0")


@dataclass(frozen=True, slots=True)
class Search:
    """A search: the attributes to match, the further attributes to return, and the page."""

    keys: tuple[Key, ...]
    include: frozenset[str]
    include_all: bool
    limit: int
    offset: int
    is_fuzzy: bool


def read_search(parameters: Iterable[tuple[str, str]]) -> Search:
    """Read the parameters of a search.

    Raises
    ------
    Problem
        422 ``unknown_parameter`` for a name that is no DICOM attribute; 422 ``unsupported_key`` for an attribute that the
        service does not match; 422 ``invalid`` for a wrong number.
    """
    keys: list[Key] = []
    include: list[str] = []
    numbers = {"limit": DEFAULT_LIMIT, "offset": 0}
    unknown: list[str] = []
    is_fuzzy = False
    for name, value in parameters:
        if name in numbers:
            if not re.fullmatch(r"[0-9]{1,9}", value):
                raise Problem(422, "invalid", f"{name} is not a number; send 0 or more.", [(f"query.{name}", "wrong")])
            numbers[name] = int(value)
        elif name == "includefield":
            include += value.split(",")
        elif name == "fuzzymatching":
            is_fuzzy = value.lower() == "true"
        elif (path := _path(name)) is not None:
            keys.append(Key(name, path, value))
        else:
            unknown.append(name)
    paths = {field: _path(field) for field in dict.fromkeys(include) if field not in ("all", "")}
    unknown += [field for field, path in paths.items() if path is None]
    if unknown:
        detail = "The address has unknown query parameters; use keywords or tags of DICOM attributes."
        raise Problem(422, "unknown_parameter", detail, [(f"query.{name}", "unknown") for name in unknown])
    if len(keys) > MOST_KEYS:
        raise Problem(422, "invalid", f"The search has {len(keys)} attributes to match; send {MOST_KEYS} at most.")
    unsupported = [key for key in keys if not key.is_universal and not _is_supported(key)]
    if unsupported:
        detail = "The service does not match some attributes of this search; leave them out."
        raise Problem(422, "unsupported_key", detail, [(f"query.{key.name}", "not matched") for key in unsupported])
    return Search(
        tuple(keys),
        frozenset(path.partition(".")[0] for path in paths.values() if path is not None),
        "all" in include,
        min(numbers["limit"], MOST_RESULTS),
        numbers["offset"],
        is_fuzzy,
    )


def tag_of(name: str) -> str | None:
    """Return an attribute's tag as eight hexadecimal digits; None for another name."""
    if re.fullmatch(r"[0-9A-Fa-f]{8}", name):
        return name.upper()
    number = tag_for_keyword(name)
    return None if number is None else f"{number:08X}"


def _path(name: str) -> str | None:
    """Return the tags of a key, outermost sequence first; None for another name."""
    tags = [tag_of(part) for part in name.split(".")] if name.count(".") <= DEEPEST_SEARCH else [None]
    return None if None in tags else ".".join(tag for tag in tags if tag is not None)


def _is_supported(key: Key) -> bool:
    representation = representation_of(key.tag)
    return not (
        key.path in _COMPUTED or key.path.startswith(PER_FRAME) or representation == "SQ" or (representation in BINARY)
    )
