"""The form in which attributes are compared in searches (PS3.4 section C.2.2.2).

Two texts with the same meaning have the same form: 10:30 and 1030 as a time, DOE^JOHN and Doe^John^^ as a name.
"""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from pydicom.datadict import dictionary_VR

NAME = "PN"
UNIQUE_IDENTIFIER = "UI"
TEMPORAL = frozenset({"DA", "TM", "DT"})
NUMERIC = frozenset({"DS", "FD", "FL", "IS", "SL", "SS", "SV", "UL", "US", "UV"})
BINARY = frozenset({"OB", "OD", "OF", "OL", "OV", "OW", "UN"})

LONGEST_BYTES = 1024
"""Longer values are not compared; the longest values of names and identifiers have a fifth of it (PS3.5 section 6.2)."""
_GROUPS = ("Alphabetic", "Ideographic", "Phonetic")
_LONGEST_NUMBER = 64
_DATE = re.compile(r"(\d{4})(?:\.?(\d\d))?(?:\.?(\d\d))?")
_TIME = re.compile(r"(\d\d)(?::?(\d\d))?(?::?(\d\d))?(?:\.(\d{1,6}))?")
_DATE_TIME = re.compile(r"(\d{4,14})(?:\.(\d{1,6}))?([+-]\d{4})?")
_DIGITS = {"DA": 8, "TM": 12, "DT": 20}
"""Digits of a value with full precision: YYYYMMDD, HHMMSSffffff, and both."""


@dataclass(frozen=True, slots=True)
class Comparable:
    """A value in the form in which it is compared.

    first : the value; of a date or time the first moment that it may mean. last : of a date or time the last one, otherwise
    None.
    """

    first: str
    last: str | None = None


def representation_of(tag: str) -> str | None:
    """Return the value representation of a standard attribute; None for a private or unknown one.

    ``tag`` is eight hexadecimal digits. Where the standard allows several, the first one counts.
    """
    try:
        return dictionary_VR(int(tag, 16)).split(" or ")[0]
    except KeyError:
        return None


def comparable_values(tag: str, element: dict[str, Any]) -> list[Comparable | None]:
    """Return the values of an attribute as searches compare them.

    ``element`` is the attribute in the DICOM JSON model.
    A person's name has one for each component group, and one for all groups together. None takes the place of a value that
    cannot be compared.
    """
    representation = representation_of(tag) or element["vr"]
    found: list[Comparable | None] = []
    for value in element.get("Value", ()):
        if isinstance(value, dict):
            groups = [name_form(str(value.get(group, ""))) for group in _GROUPS]
            together = "=".join(groups).rstrip("=")
            found += [Comparable(text) for text in dict.fromkeys([*groups, together]) if text]
        elif value is not None and (text := str(value).strip(" \0")):
            found.append(comparable(representation, text))
    return [each if each is None or _is_short(each.first) else None for each in found]


def comparable(representation: str, text: str) -> Comparable | None:
    """Return a value as searches compare it.

    None for a malformed date, time or number.
    """
    if representation in TEMPORAL:
        return time_form(representation, text)
    if representation in NUMERIC:
        number = number_form(text)
        return None if number is None else Comparable(number)
    return Comparable(name_form(text) if representation == NAME else text_form(text))


def text_form(text: str) -> str:
    """Return a text without the spaces around it.

    NUL goes too, because a database does not store it.
    """
    return text.replace("\0", "").strip(" ")


def name_form(text: str) -> str:
    """Return a person's name, or a group of it, for comparison.

    Case and empty components at the end do not count.
    An empty component at the end may be left out with its caret (PS3.5 section 6.2.1.1). A text that is too long to be
    compared keeps its form: composing many marks would take the square of their number.
    """
    if len(text) > LONGEST_BYTES:
        return text
    return unicodedata.normalize("NFC", text_form(text).casefold()).rstrip("^ ")


def number_form(text: str) -> str | None:
    """Return a number as it is compared; None for another text."""
    if len(text) > _LONGEST_NUMBER or not text.isascii() or "_" in text:
        return None
    try:
        return str(int(text))
    except ValueError:
        pass
    try:
        number = float(text)
    except ValueError:
        return None
    if not math.isfinite(number):
        return None
    return str(int(number)) if number == int(number) else repr(number)


def time_form(representation: str, text: str) -> Comparable | None:
    """Return the first and last moment that a text may mean.

    None for a malformed text.
    The old forms with dots and colons count too. A moment with an offset is compared in UTC.
    """
    text = text.strip(" \0")
    if not text.isascii() or len(text) > _LONGEST_NUMBER:
        return None
    if representation == "DT":
        digits = _digits_of_date_time(text)
    else:
        found = (_DATE if representation == "DA" else _TIME).fullmatch(text)
        digits = None if found is None else "".join(part or "" for part in found.groups())
    if digits is None:
        return None
    length = _DIGITS[representation]
    return Comparable(digits.ljust(length, "0"), digits.ljust(length, "9"))


def _digits_of_date_time(text: str) -> str | None:
    found = _DATE_TIME.fullmatch(text)
    if found is None or len(found[1]) % 2 or (found[2] and len(found[1]) != 14):
        return None
    digits, fraction, offset = found[1], found[2] or "", found[3]
    if offset is None or len(digits) < 10:
        return digits + fraction
    hours, minutes = int(offset[:3]), int(offset[0] + offset[3:])
    if abs(hours) > 14 or abs(minutes) > 59:
        return None
    try:
        moment = datetime.strptime(digits.ljust(14, "0"), "%Y%m%d%H%M%S") - timedelta(hours=hours, minutes=minutes)
    except (ValueError, OverflowError):
        return None
    # An offset of half hours needs the minutes, whatever precision the text has.
    kept = max(len(digits), 12) if minutes else len(digits)
    return f"{moment.year:04}{moment:%m%d%H%M%S}"[:kept] + fraction


def _is_short(text: str) -> bool:
    return len(text.encode()) <= LONGEST_BYTES
