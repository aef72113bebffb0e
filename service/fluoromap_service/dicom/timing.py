"""The times of a run and of its frames."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone

from fluoromap_service.dicom.date_times import date_text, date_time_text, time_text
from fluoromap_service.dicom.facts import HeaderWarning
from fluoromap_service.dicom.header import Header

_LONGEST_INTERVAL_MS = 10_000.0
_ASSUMED_INTERVAL_MS = 1000.0 / 15
_FRAME_TIME = 0x00181063
_MOMENT = re.compile(r"(\d{4})(\d\d)(\d\d)(?:(\d\d)(?:(\d\d)(?:(\d\d)(?:\.(\d+))?)?)?)?([+-]\d{4})?")
_DAY_S, _SHORTEST_S = 86_400.0, 1e-6
_PRECISIONS_S = {3: _DAY_S, 4: 3600.0, 5: 60.0, 6: 1.0}
"""Seconds within which a moment lies of which a header states so many of year, month, day, hour, minute and second."""


def frame_times_ms(header: Header, frames: int, warnings: list[HeaderWarning]) -> tuple[float, ...]:
    """Return the time of each frame from the first on, in ms, never falling.

    FrameIncrementPointer (0028,0009) chooses between FrameTime (0018,1063) and FrameTimeVector (0018,1065), PS3.3 C.7.6.5.
    Without these the function takes, in this order: the frames' own clock times (Enhanced objects), CineRate,
    RecommendedDisplayFrameRate.
    """
    if frames == 1:
        return (0.0,)
    constant, vector = _frame_time(header, frames), _frame_time_vector(header, frames)
    first, second = (constant, vector) if _FRAME_TIME in header.tags("FrameIncrementPointer") else (vector, constant)
    times = first or second or _frame_clocks(header, frames) or _frame_rate(header, frames)
    if times is not None:
        return times
    warnings.append(HeaderWarning.FRAME_TIME_ASSUMED)
    return tuple(_ASSUMED_INTERVAL_MS * frame for frame in range(frames))


def _evenly(interval_ms: float | None, frames: int) -> tuple[float, ...] | None:
    if interval_ms is None or not 0 < interval_ms <= _LONGEST_INTERVAL_MS:
        return None
    return tuple(interval_ms * frame for frame in range(frames))


def _frame_time(header: Header, frames: int) -> tuple[float, ...] | None:
    return _evenly(header.number("FrameTime"), frames)


def _frame_time_vector(header: Header, frames: int) -> tuple[float, ...] | None:
    # One increment a frame, of which the first is 0; some systems leave the first out.
    vector = header.numbers("FrameTimeVector")
    increments = vector[1:] if len(vector) == frames else vector
    if len(increments) != frames - 1 or not all(0 < value <= _LONGEST_INTERVAL_MS for value in increments):
        return None
    return (0.0, *itertools.accumulate(increments))


def _frame_clocks(header: Header, frames: int) -> tuple[float, ...] | None:
    return _clock_steps(header, frames, "FrameAcquisitionDateTime") or _clock_steps(
        header, frames, "FrameReferenceDateTime"
    )


def _clock_steps(header: Header, frames: int, keyword: str) -> tuple[float, ...] | None:
    starts = [_start(values[0], None) if values else None for values in header.texts_per_frame(keyword)]
    known = [start.earliest for start in starts if start is not None]
    if len(known) != frames or not all(
        0 < (later - earlier).total_seconds() * 1000 <= _LONGEST_INTERVAL_MS
        for earlier, later in itertools.pairwise(known)
    ):
        return None
    return tuple((clock - known[0]).total_seconds() * 1000 for clock in known)


def _frame_rate(header: Header, frames: int) -> tuple[float, ...] | None:
    for keyword in ("CineRate", "RecommendedDisplayFrameRate"):
        rate = header.number(keyword)
        if rate and rate > 0 and (times := _evenly(1000.0 / rate, frames)):
            return times
    return None


@dataclass(frozen=True, slots=True)
class Start:
    """The start of a run, as exactly as the header states it.

    Parameters
    ----------
    earliest : datetime
        UTC; a time without zone counts as UTC.
    within_s : float
        Seconds after ``earliest`` within which the run began: 1 for a time in whole seconds, 86400 for a date alone.
    zone_known : bool
        Whether the header states the offset from UTC.
    """

    earliest: datetime
    within_s: float
    zone_known: bool

    def contains(self, other: Start) -> bool:
        """Return whether another statement may mean the same moment."""
        return 0 <= (other.earliest - self.earliest).total_seconds() < max(self.within_s, _SHORTEST_S)


def acquisition_start(header: Header) -> Start | None:
    """Return the start of the run; None where the header states no day.

    These state it, the most direct first: AcquisitionDateTime, and the Acquisition, Content and Series date and time. The
    first with a time of the day counts; a later one replaces it that states the same moment more exactly. AcquisitionTime
    without its date takes the day on which it is nearest to the moment of another attribute. Without any time of the day the
    first date counts.
    """
    found = [start for start in _starts(header) if start is not None]
    timed = [start for start in found if start.within_s < _DAY_S]
    if not timed:
        return found[0] if found else None
    best = timed[0]
    for start in timed[1:]:
        if start.within_s < best.within_s and best.contains(start):
            best = start
    return best


def _starts(header: Header) -> Iterator[Start | None]:
    zone = _zone(header.text("TimezoneOffsetFromUTC"))
    yield _start(header.text("AcquisitionDateTime"), zone)
    dates = {kind: date_text(header.text(f"{kind}Date")) for kind in ("Acquisition", "Content", "Series", "Study")}
    times = {kind: time_text(header.text(f"{kind}Time")) for kind in dates}
    if not dates["Acquisition"] and times["Acquisition"]:
        day = date_text(date_time_text(header.text("AcquisitionDateTime"))[:8])
        others = [(day, ""), *((dates[kind], times[kind]) for kind in ("Content", "Series", "Study"))]
        yield next((_nearest(times["Acquisition"], *other, zone) for other in others if other[0]), None)
    for kind in ("Acquisition", "Content", "Series"):
        yield _start(dates[kind] + times[kind], zone) if dates[kind] else None


def _nearest(time: str, day: str, day_time: str, zone: timezone | None) -> Start | None:
    """Return a time of the day on the right day.

    On that day it is nearest to another moment. A run that begins before midnight may have the date of its end, and a series
    begins before its last run.
    """
    start, other = _start(day + time, zone), _start(day + day_time, zone)
    if start is None or other is None or not day_time:
        return start
    apart_s = (start.earliest - other.earliest).total_seconds()
    days = -round(apart_s / _DAY_S)
    return dataclasses.replace(start, earliest=start.earliest + timedelta(days=days))


def _start(text: str, zone: timezone | None) -> Start | None:
    match = _MOMENT.fullmatch(date_time_text(text))
    if match is None:
        return None
    *fields, fraction, offset = match.groups()
    known = _zone(offset) or zone
    year, month, day, hour, minute, second = (int(field or 0) for field in fields)
    try:
        # A leap second is the last one of its minute for Python's clock.
        earliest = datetime(
            year, month, day, hour, minute, min(second, 59), int((fraction or "0").ljust(6, "0")), tzinfo=known or UTC
        ).astimezone(UTC)
    except (ValueError, OverflowError):
        return None
    within_s = 10.0 ** -len(fraction) if fraction else _PRECISIONS_S[sum(field is not None for field in fields)]
    return Start(earliest, within_s, known is not None)


def _zone(offset: str | None) -> timezone | None:
    if not offset or not re.fullmatch(r"[+-]\d{4}", offset):
        return None
    minutes = int(offset[1:3]) * 60 + int(offset[3:])
    if minutes >= 24 * 60:
        return None
    return timezone(timedelta(minutes=minutes if offset[0] == "+" else -minutes))
