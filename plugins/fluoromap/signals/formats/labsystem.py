"""LabSystem Pro (Bard, Boston Scientific): one text file with a header, a description of each channel, and integers."""

from __future__ import annotations

import re
from codecs import BOM_UTF8 as BOM
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import time

import numpy as np

from fluoromap.signals.channel_names import described
from fluoromap.signals.recording import MILLIVOLT, Channel, ChannelKind, NotARecording, Recording, Samples, Sources
from fluoromap.signals.sample_table import SampleTable

FORMAT = "LabSystem Pro"
_COUNTS = 32768.0
"""Counts of the recorder's full range; a count is the range over this number."""
_LONGEST_HEADER_BYTES = 2**20
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


@dataclass(slots=True)
class _Described:
    """Entries of one channel's description by their keys in lower case."""

    entries: dict[str, str] = field(default_factory=dict)

    def number(self, key: str) -> float | None:
        found = _NUMBER.search(self.entries.get(key, ""))
        return float(found[0]) if found else None


def recognises(name: str, head: bytes) -> bool:
    """Return whether a file begins as a LabSystem Pro export."""
    return head.removeprefix(BOM).lstrip().startswith(b"[Header]")


def read(sources: Sources) -> Recording:
    """Read the header of an export.

    Raises
    ------
    NotARecording
        When the header is incomplete.
    """
    (path,) = sources.values()
    header, channels, start, line = _Described(), list[_Described](), 0, 0
    with path.open("rb") as stream:
        for raw in iter(stream.readline, b""):
            line += 1
            start += len(raw)
            text = raw.removeprefix(BOM).decode("latin-1").strip()
            if text.startswith("[Data]"):
                break
            if start > _LONGEST_HEADER_BYTES:
                raise NotARecording("The export has no line [Data] in its first MiB; export the recording again.")
            key, colon, value = text.partition(":")
            if not colon:
                continue
            key = " ".join(key.lower().split())
            if key == "channel #":
                channels.append(_Described())
            (channels[-1] if channels else header).entries[key] = value.strip()
        else:
            raise NotARecording("The export ends before its line [Data]; export the recording again.")
    announced = header.number("channels exported")
    if announced is not None and int(announced) != len(channels):
        raise NotARecording(
            f"The header announces {int(announced)} channels and describes {len(channels)}; export the recording again."
        )
    common = header.number("sample rate")
    made = tuple(_channel(one, number, common) for number, one in enumerate(channels, 1))
    gains = np.array([_gain(one) for one in channels])
    table = SampleTable(path, start, line + 1, len(made), ",")
    count = table.count_lines()
    lacking = header.number("samples per channel")
    warnings: tuple[str, ...] = ()
    if lacking is not None and int(lacking) != count:
        warnings = (f"The header announces {int(lacking)} samples for each channel, and the file has {count}.",)

    def blocks() -> Iterator[tuple[Samples, ...]]:
        for piece in table.pieces():
            yield tuple((piece * gains).astype(np.float32).T)

    return Recording(FORMAT, made, (count,) * len(made), blocks, _clock(header.entries.get("start time", "")), warnings)


def _channel(one: _Described, number: int, common_hz: float | None) -> Channel:
    rate = one.number("sample rate") or common_hz
    if not rate:
        raise NotARecording(f"Channel {number} has no sample rate; export the recording again.")
    unit = MILLIVOLT if one.number("range") is not None else None
    name = one.entries.get("label") or f"channel {number}"
    return described(Channel(name, rate, unit, ChannelKind.OTHER, low_hz=one.number("low"), high_hz=one.number("high")))


def _gain(one: _Described) -> float:
    """Return the millivolts of one count; 1 where the range is not stated."""
    reach = one.number("range")
    if reach is None:
        return 1.0
    unit = one.entries["range"].lower()
    factor = 1e-3 if "uv" in unit or "µv" in unit else 1e3 if re.search(r"\d\s*v", unit) else 1.0
    return reach * factor / _COUNTS


def _clock(text: str) -> time | None:
    found = re.fullmatch(r"(\d{1,2}):(\d{2}):(\d{2})(?:[.,](\d{1,6}))?", text.strip())
    if not found:
        return None
    hour, minute, second = (int(part) for part in found.groups()[:3])
    if hour > 23 or minute > 59 or second > 59:
        return None
    return time(hour, minute, second, int((found[4] or "0").ljust(6, "0")))
