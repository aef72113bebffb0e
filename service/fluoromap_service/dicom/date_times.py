"""The texts of dates and times: the form of PS3.5 table 6.2-1, from other forms whose meaning is certain."""

from __future__ import annotations

import re
from datetime import date

_COMPACT_DATE = re.compile(r"(\d{4})(\d\d)(\d\d)")
_DATE = re.compile(r"(\d{4})([./-])(\d\d?)\2(\d\d?)")
_COMPACT_TIME = re.compile(r"(\d\d)(?:(\d\d)(?:(\d\d)(?:\.(\d+))?)?)?")
_TIME = re.compile(r"(\d\d?):(\d\d)(?::(\d\d)(?:\.(\d+))?)?")
_OFFSET = re.compile(r"(.*?)(?:([+-]\d\d):?(\d\d)|(Z))?")
_DAY = re.compile(r"\d{8}|\d{4}([./-])(?:\d\d\1\d\d|\d\d?\1\d\d?(?=[T ]|$))")
_FRACTION_DIGITS = 6
_LEAST_OFFSET, _LARGEST_OFFSET = -1200, 1400
"""Hours and minutes as one number; PS3.3 section C.12.1.1.8."""


def date_text(text: str) -> str:
    """Return a day as YYYYMMDD; empty where the text is no day of the calendar.

    Year, month and day in this order may have dots, hyphens or slashes between them.
    """
    match = _COMPACT_DATE.fullmatch(text)
    numbers = match.groups() if match else ()
    if not match and (match := _DATE.fullmatch(text)):
        numbers = match.group(1, 3, 4)
    try:
        year, month, day = map(int, numbers)
        date(year, month, day)
    except ValueError:
        return ""
    return f"{year:04}{month:02}{day:02}"


def time_text(text: str) -> str:
    """Return a time of day as HH[MM[SS[.F]]]; empty for another text.

    It may have colons. A fraction of more than six digits is cut.
    """
    match = _COMPACT_TIME.fullmatch(text) or _TIME.fullmatch(text)
    if match is None:
        return ""
    hour, minute, second, fraction = match.groups()
    # A minute may have a leap second, PS3.5 table 6.2-1.
    if int(hour) > 23 or int(minute or 0) > 59 or int(second or 0) > 60:
        return ""
    return f"{int(hour):02}{minute or ''}{second or ''}" + (f".{fraction[:_FRACTION_DIGITS]}" if fraction else "")


def date_time_text(text: str) -> str:
    """Return a date with time as YYYY[MM[DD[HH[MM[SS[.F]]]]]][&ZZXX]; empty for another text.

    The forms of :func:`date_text` and :func:`time_text` may follow each other, also with a blank or T between them. The offset
    from UTC may have a colon; Z means +0000. An offset that no place on earth has is left out.
    """
    match = _OFFSET.fullmatch(text)
    if match is None:
        return ""
    moment, hours, minutes, utc = match.groups()
    plain = _moment_text(moment)
    if not plain or (hours is None and utc is None):
        return plain
    if utc:
        return f"{plain}+0000"
    return f"{plain}{hours}{minutes}" if _LEAST_OFFSET <= int(f"{hours}{minutes}") <= _LARGEST_OFFSET else plain


def _moment_text(text: str) -> str:
    if re.fullmatch(r"\d{4}(0[1-9]|1[0-2])?", text):
        return text
    head = _DAY.match(text)
    if head is None:
        return ""
    day, rest = date_text(head[0]), text[head.end() :]
    if not day or not rest:
        return day
    time = time_text(rest.removeprefix("T").strip())
    return day + time if time else ""
