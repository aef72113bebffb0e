"""EP-Tracer (Schwarzer): one table with semicolons, a column for each channel with its unit in brackets."""

from __future__ import annotations

import re
from codecs import BOM_UTF8 as BOM
from collections.abc import Iterator
from datetime import datetime, timedelta

import numpy as np

from fluoromap.signals.channel_names import described
from fluoromap.signals.recording import MILLIVOLT, Channel, ChannelKind, NotARecording, Recording, Samples, Sources
from fluoromap.signals.sample_table import SampleTable

FORMAT = "EP-Tracer"
_COLUMN = re.compile(r"(?P<name>.*?)\s*\[(?P<unit>[^\]]*)\]")
_TIMES_LOOKED_AT = 4000
_DAY_SECONDS = 86400.0
_LONGEST_LINE_BYTES = 2**16
_VOLTS = {"mv": 1.0, "uv": 1e-3, "µv": 1e-3, "v": 1e3}
"""Millivolts of each unit."""


def recognises(name: str, head: bytes) -> bool:
    """Return whether a file begins as an EP-Tracer export."""
    return head.removeprefix(BOM).lstrip().startswith(b"TimeOfDay") and b";" in head


def read(sources: Sources) -> Recording:
    """Read the column names of an export.

    The times of its first samples give the rate.

    Raises
    ------
    NotARecording
        When a column has no unit, or the times do not rise evenly.
    """
    (path,) = sources.values()
    with path.open("rb") as stream:
        head = stream.readline(_LONGEST_LINE_BYTES)
        start = stream.tell()
        lines = [stream.readline(_LONGEST_LINE_BYTES).decode("latin-1") for _ in range(_TIMES_LOOKED_AT)]
    names = head.removeprefix(BOM).decode("latin-1").strip().rstrip(";").split(";")[1:]
    first = [line for line in lines if line.strip()]
    if len(first) < 2:
        raise NotARecording("The export has less than two samples; export a longer part.")
    seconds = [_seconds(line.split(";")[0], number) for number, line in enumerate(first, 2)]
    span = seconds[-1] - seconds[0]
    if span <= 0:
        raise NotARecording("The times of the first samples do not rise; export the recording again.")
    rate = round((len(seconds) - 1) / span, 1)
    comma = "," in "".join(first[0].split(";")[1:])
    channels, gains = [], []
    for number, name in enumerate(names, 2):
        found = _COLUMN.fullmatch(name.strip())
        if found is None:
            raise NotARecording(f"Column {number} has no unit in brackets, such as [mV]; export the recording again.")
        gain = _VOLTS.get(found["unit"].strip().lower())
        unit = MILLIVOLT if gain is not None else found["unit"]
        channels.append(described(Channel(found["name"], rate, unit, ChannelKind.OTHER)))
        gains.append(gain or 1.0)
    table = SampleTable(path, start, 2, len(channels), ";", comma, skipped=1)
    count, factors = table.count_lines(), np.array(gains)

    def blocks() -> Iterator[tuple[Samples, ...]]:
        for piece in table.pieces():
            yield tuple((piece * factors).astype(np.float32).T)

    started = (datetime.min + timedelta(seconds=seconds[0])).time() if seconds[0] < _DAY_SECONDS else None
    return Recording(FORMAT, tuple(channels), (count,) * len(channels), blocks, started)


def _seconds(text: str, line: int) -> float:
    """Return a time of day in seconds: ``HH:MM:SS.fff`` or a number of seconds."""
    try:
        total = 0.0
        for part in text.strip().replace(",", ".").split(":"):
            total = 60.0 * total + float(part)
    except ValueError:
        raise NotARecording(f"Line {line} does not begin with a time of day; export the recording again.") from None
    return total
