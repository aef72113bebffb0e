"""The rules by which an object matches a search, as conditions of SQL (PS3.4 section C.2.2.2).

The database compares: no pattern becomes a regular expression, and a search over many objects holds no other request up.
"""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, Select, and_, false, intersect, literal, or_, select
from sqlalchemy.orm import InstrumentedAttribute, aliased

from fluoromap_service.api.dicomweb.search_parameters import Key
from fluoromap_service.dicom.matching import (
    LONGEST_BYTES,
    NAME,
    NUMERIC,
    TEMPORAL,
    UNIQUE_IDENTIFIER,
    Comparable,
    name_form,
    number_form,
    representation_of,
    text_form,
    time_form,
)
from fluoromap_service.problem import Problem
from fluoromap_service.store.models import DicomObject, DicomValue
from fluoromap_service.study.dicom_index import MODALITY, SOP_CLASS

Condition = ColumnElement[bool]
Text = ColumnElement[Any] | InstrumentedAttribute[str | None]

MODALITIES_IN_STUDY, SOP_CLASSES_IN_STUDY, AVAILABILITY = "00080061", "00080062", "00080056"
ONLINE = "ONLINE"
"""Instance Availability of every object."""
MOST_ALTERNATIVES = 1000
"""Values of a list; a longer list is refused."""
_OF_STUDY = {MODALITIES_IN_STUDY: MODALITY, SOP_CLASSES_IN_STUDY: SOP_CLASS}
"""Attributes that gather an attribute of all objects of a study."""
_COLUMNS = {MODALITY: "modality", SOP_CLASS: "sop_class_uid"}
_PLACE = {"0020000D": DicomObject.study_uid, "0020000E": DicomObject.series_uid, "00080018": DicomObject.uid}
"""Attributes that are columns."""
PLACE_TAGS = tuple(_PLACE)
"""StudyInstanceUID, SeriesInstanceUID and SOPInstanceUID."""
_DATE_AND_TIME = {
    "00080020": "00080030", "00080021": "00080031", "00080022": "00080032", "00080023": "00080033",
    "00400244": "00400245", "00400250": "00400251",
}  # fmt: skip
"""Dates and their times: ranges of both are one range of moments (PS3.4 section C.2.2.2.5.4)."""
_MOMENT = r"\d{4,14}(?:\.\d{1,6})?(?:[+-](?:0\d|1[0-4])[0-5]\d)?"
_RANGE_OF_DATE_TIME = re.compile(rf"({_MOMENT})?\s*-\s*({_MOMENT})?")
_NAME_COMPONENTS = 5


def conditions_of(keys: Sequence[Key], dialect: str) -> list[Condition]:
    """Return the conditions on an object, all of which must hold.

    Parameters
    ----------
    keys : sequence of Key
    dialect : str
        "sqlite" or "postgresql".

    Raises
    ------
    Problem
        422 ``invalid`` for a value that the attribute cannot have.
    """
    wanted = [key for key in keys if not key.is_universal]
    found: list[Condition] = []
    combined: set[int] = set()
    for date, time in itertools.permutations(range(len(wanted)), 2) if len(wanted) > 1 else ():
        if _DATE_AND_TIME.get(wanted[date].path) == wanted[time].path and {date, time}.isdisjoint(combined):
            ranges = _range(wanted[date], "DA"), _range(wanted[time], "TM")
            if all("-" in wanted[number].text for number in (date, time)):
                combined |= {date, time}
                found.append(_combined(wanted[date].path, wanted[time].path, *ranges))
    nested: dict[str, list[Select[int, int]]] = defaultdict(list)
    for number, key in enumerate(wanted):
        if number in combined:
            continue
        if key.path == AVAILABILITY:
            found.append(_listed(literal(ONLINE), key, dialect))
        elif key.path in _PLACE:
            found.append(_PLACE[key.path].in_(_alternatives(key)))
        elif key.path in _COLUMNS:
            found.append(_listed(getattr(DicomObject, _COLUMNS[key.path]), key, dialect))
        elif key.path in _OF_STUDY:
            member = aliased(DicomObject)
            column = getattr(member, _COLUMNS[_OF_STUDY[key.path]])
            found.append(DicomObject.study_uid.in_(select(member.study_uid).where(_listed(column, key, dialect))))
        else:
            parent = key.path.rpartition(".")[0]
            query = select(DicomValue.object_id, DicomValue.item)
            nested[parent or key.path].append(query.where(DicomValue.path == key.path, _value(key, dialect)))
    for queries in nested.values():
        # All keys of one sequence match in the same item (PS3.4 section C.2.2.2.6).
        both = queries[0].subquery() if len(queries) == 1 else intersect(*queries).subquery()
        found.append(DicomObject.id.in_(select(both.c.object_id)))
    return found


def places_of(keys: Sequence[Key]) -> dict[str, list[str]]:
    """Return the UIDs to which a search is limited, by the tag of the attribute."""
    return {key.path: _alternatives(key) for key in keys if key.path in _PLACE and not key.is_universal}


def _value(key: Key, dialect: str) -> Condition:
    """Return the condition on a row of values with the attribute's path."""
    representation = representation_of(key.tag)
    if representation in TEMPORAL:
        return _overlaps(DicomValue.first, DicomValue.last, *_range(key, representation))
    if representation == UNIQUE_IDENTIFIER:
        return DicomValue.first.in_(_alternatives(key))
    if representation == "CS":
        return _listed(DicomValue.first, key, dialect)
    if representation in NUMERIC:
        number = number_form(text_form(key.text))
        if number is not None:
            return DicomValue.first == number
        if not any(wildcard in key.text for wildcard in "*?"):
            raise _invalid(key, "a number")
    if representation == NAME:
        return or_(*(_like(DicomValue.first, text, dialect) for text in _name_patterns(key.text)))
    return _like(DicomValue.first, text_form(key.text), dialect)


def _alternatives(key: Key) -> list[str]:
    """Return the values of a list, which has commas or backslashes between."""
    texts = list(dict.fromkeys(text.strip(" ") for text in re.split(r"[,\\]", text_form(key.text))))
    if len(texts) > MOST_ALTERNATIVES:
        raise _invalid(key, f"a list of at most {MOST_ALTERNATIVES} values")
    return [text for text in texts if text]


def _listed(value: Text, key: Key, dialect: str) -> Condition:
    """Return the condition that a text matches one value of a list."""
    return or_(false(), *(_like(value, text, dialect) for text in _alternatives(key)))


def _name_patterns(text: str) -> list[str]:
    """Return the patterns of a person's name.

    A value without components at the end has no carets there, so the pattern ``DOE^*`` means ``DOE`` too.
    """
    pattern = _collapsed("=".join(name_form(group) for group in text.split("=")).rstrip("="))
    patterns = [pattern]
    while pattern.endswith("^*") and len(patterns) < _NAME_COMPONENTS:
        pattern = pattern.removesuffix("^*").rstrip("^")
        patterns.append(pattern)
    return patterns


def _like(value: Text, pattern: str, dialect: str) -> Condition:
    """Return the condition that a text matches a pattern with ``*`` and ``?``."""
    pattern = _collapsed(pattern)
    beginning = "".join(itertools.takewhile(lambda character: character not in "*?", pattern))
    if len(pattern.replace("*", "").encode()) > LONGEST_BYTES:
        return false()
    if beginning == pattern:
        return value == pattern
    parts: list[Condition] = []
    if beginning:
        # The range is what an index serves; every database orders these columns by code points.
        parts.append(value >= beginning)
        if (end := _after(beginning)) is not None:
            parts.append(value < end)
    if pattern != f"{beginning}*":
        parts.append(_glob(value, pattern) if dialect == "sqlite" else _sql_like(value, pattern))
    return and_(*parts) if parts else value.is_not(None)


def _glob(value: Text, pattern: str) -> Condition:
    # SQLite's LIKE knows no case.
    return value.op("GLOB", is_comparison=True)(pattern.replace("[", "[[]"))


def _sql_like(value: Text, pattern: str) -> Condition:
    escaped = re.sub(r"([\\%_])", r"\\\1", pattern)
    return value.like(escaped.replace("*", "%").replace("?", "_"), escape="\\")


def _after(text: str) -> str | None:
    """Return the first text after all those with a beginning.

    None when there is none.
    """
    last = ord(text[-1])
    if last == 0x10FFFF:
        return None
    # Half surrogate pairs lie between, which no text has.
    return text[:-1] + chr(0xE000 if last == 0xD7FF else last + 1)


def _collapsed(pattern: str) -> str:
    """Return the same pattern with fewer stars.

    Each row of wildcards has one star at most.
    """
    parts = []
    for is_wildcard, characters in itertools.groupby(pattern, "*?".__contains__):
        part = "".join(characters)
        parts.append("?" * part.count("?") + "*" * ("*" in part) if is_wildcard else part)
    return "".join(parts)


def _range(key: Key, representation: str) -> tuple[str, str]:
    """Return the first and the last moment that a key means.

    The key is a date, a time, both, or a range of them.
    """
    text = text_form(key.text).rstrip("*")
    single = time_form(representation, text)
    if single is not None and single.last is not None:
        return single.first, single.last
    if representation == "DT":
        found = _RANGE_OF_DATE_TIME.fullmatch(text)
        ends = ["", ""] if found is None else [found[1] or "", found[2] or ""]
    else:
        first, _, last = text.partition("-")
        ends = [first.strip(), last.strip()]
    times = [time_form(representation, end) if end else Comparable("", "~") for end in ends]
    start, end = times
    if not any(ends) or "-" not in text or start is None or end is None or end.last is None:
        raise _invalid(key, "a date or time as DICOM writes it, or a range of two")
    return start.first, end.last


def _overlaps(first: Text, last: Text, start: str, end: str) -> Condition:
    return and_(first <= end, last >= start)


def _combined(date_path: str, time_path: str, dates: tuple[str, str], times: tuple[str, str]) -> Condition:
    """Return the condition that date and time lie in one range."""
    time = aliased(DicomValue)
    start, end = dates[0] and dates[0] + times[0], dates[1] + times[1]
    moments = select(DicomValue.object_id).join(time, time.object_id == DicomValue.object_id)
    moments = moments.where(DicomValue.path == date_path, time.path == time_path)
    moments = moments.where(
        _overlaps(DicomValue.first, DicomValue.last, *dates),
        _overlaps(DicomValue.first + time.first, DicomValue.last + time.last, start, end),
    )
    return DicomObject.id.in_(moments)


def _invalid(key: Key, expected: str) -> Problem:
    return Problem(422, "invalid", f"{key.name} is not {expected}.", [(f"query.{key.name}", f"send {expected}")])
