"""The times of a run and of its frames."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta, timezone

from fluoromap_service.dicom.facts import HeaderWarning
from fluoromap_service.dicom.header import Header

_LONGEST_INTERVAL_MS = 10_000.0
_ASSUMED_INTERVAL_MS = 1000.0 / 15
_FRAME_TIME = 0x00181063
_CLOCK = re.compile(r"(\d{4})\.?(\d\d)\.?(\d\d)(\d\d)?:?(\d\d)?:?(\d\d)?(?:\.(\d{1,6})\d*)?([+-]\d{4})?")


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
    clocks = [_clock(values[0], UTC) if values else None for values in header.texts_per_frame(keyword)]
    known = [clock for clock in clocks if clock is not None]
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


def acquisition_time(header: Header) -> datetime | None:
    """Return the start of the run in UTC.

    The first that exists of AcquisitionDateTime, and of the Acquisition, Content and Series date and time.
    """
    zone = _zone(header.text("TimezoneOffsetFromUTC")) or UTC
    for text in _clock_texts(header):
        if clock := _clock(text, zone):
            return clock
    return None


def _clock_texts(header: Header) -> Iterator[str]:
    yield header.text("AcquisitionDateTime")
    for kind in ("Acquisition", "Content", "Series"):
        date, time = header.text(f"{kind}Date"), header.text(f"{kind}Time")
        if date and time:
            yield date + time


def _clock(text: str, zone: timezone) -> datetime | None:
    match = _CLOCK.fullmatch(text)
    if match is None:
        return None
    year, month, day, hour, minute, second, fraction, offset = match.groups()
    try:
        moment = datetime(
            int(year), int(month), int(day), int(hour or 0), int(minute or 0), int(second or 0),
            int((fraction or "0").ljust(6, "0")), tzinfo=_zone(offset) or zone,
        )  # fmt: skip
        return moment.astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def _zone(offset: str | None) -> timezone | None:
    if not offset or not re.fullmatch(r"[+-]\d{4}", offset):
        return None
    minutes = int(offset[1:3]) * 60 + int(offset[3:])
    if minutes >= 24 * 60:
        return None
    return timezone(timedelta(minutes=minutes if offset[0] == "+" else -minutes))
