"""CardioLab (Prucka, GE): a text file of samples, and a file ``.inf`` that describes it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import numpy as np

from fluoromap.signals.channel_names import described
from fluoromap.signals.recording import MILLIVOLT, Channel, ChannelKind, NotARecording, Recording, Samples, Sources
from fluoromap.signals.sample_table import SampleTable

FORMAT = "CardioLab"
_DESCRIPTION_BYTES = 2**20
_ROW = re.compile(r"\s*(\d{1,3})\s+(\S.*?)\s*")
_PRESSURES = re.compile(r"(?:ABP|ART|AO|LVP|RVP|PAP|PCW|P\d)", re.IGNORECASE)


def recognises(name: str, head: bytes) -> bool:
    """Return whether a file begins as the description of a CardioLab export."""
    return b"Number of Channel" in head and b"Data Sampling Rate" in head


def read(sources: Sources) -> Recording:
    """Read the description of an export.

    A file of samples may begin each line with the sample's number: the number of columns says so.

    Raises
    ------
    NotARecording
        When description or samples are missing.
    """
    description = next(path for path in sources.values() if recognises("", _head(path)))
    others = [path for path in sources.values() if path != description]
    if len(others) != 1:
        raise NotARecording(
            f"A CardioLab export is one .inf file and one .txt file; {len(others)} files came beside the .inf file. Send both."
        )
    entries, labels = _entries(_head(description).decode("latin-1"))
    rate = _number(entries, "data sampling rate")
    announced = _number(entries, "number of channel")
    if rate is None or rate <= 0:
        raise NotARecording("The .inf file states no Data Sampling Rate; export the recording again.")
    if announced is None or int(announced) != len(labels):
        raise NotARecording(
            f"The .inf file announces {announced or 0:.0f} channels and names {len(labels)}; export the recording again."
        )
    first = _first_line(others[0])
    separator = "," if "," in first else " "
    columns = len(first.replace(",", " ").split())
    if columns not in (len(labels), len(labels) + 1):
        raise NotARecording(
            f"The first line has {columns} numbers, and the .inf file names {len(labels)} channels; export the recording again."
        )
    skipped = columns - len(labels)
    table = SampleTable(others[0], 0, 1, columns, separator)
    channels = tuple(_channel(label, rate) for label in labels)
    count = table.count_lines()

    def blocks() -> Iterator[tuple[Samples, ...]]:
        for piece in table.pieces():
            yield tuple(np.asarray(piece[:, skipped:], np.float32).T)

    stated = _number(entries, "points for each channel")
    warnings: tuple[str, ...] = ()
    if stated is not None and int(stated) != count:
        warnings = (f"The .inf file announces {int(stated)} samples for each channel, and the file has {count}.",)
    return Recording(FORMAT, channels, (count,) * len(channels), blocks, _started(entries), warnings)


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(_DESCRIPTION_BYTES)


def _first_line(path: Path) -> str:
    with path.open("rb") as stream:
        return stream.readline(2**16).decode("latin-1")


def _entries(text: str) -> tuple[dict[str, str], list[str]]:
    """Return the entries, and the channels' names in the order of their columns.

    The keys of the entries are in lower case.
    """
    entries: dict[str, str] = {}
    labels: list[str] = []
    in_table = False
    for line in text.splitlines():
        if in_table:
            row = _ROW.fullmatch(line)
            if row:
                labels.append(row[2])
            elif line.strip() and labels:
                in_table = False
        if "channel number" in line.lower() and "label" in line.lower():
            in_table = True
            continue
        key, equals, value = line.partition("=")
        if equals and not in_table:
            entries[" ".join(key.lower().split())] = value.strip()
    return entries, labels


def _number(entries: dict[str, str], key: str) -> float | None:
    found = re.search(r"\d+(?:\.\d+)?", entries.get(key, ""))
    return float(found[0]) if found else None


def _channel(label: str, rate: float) -> Channel:
    # The description says: mmHg for pressure and mV for all others.
    unit = "mmHg" if _PRESSURES.match(label) else MILLIVOLT
    return described(Channel(label, rate, unit, ChannelKind.OTHER))


def _started(entries: dict[str, str]) -> datetime | None:
    for form in ("%m/%d/%Y %I:%M:%S %p", "%m/%d/%Y %H:%M:%S"):
        try:
            return datetime.strptime(entries.get("start time", ""), form)
        except ValueError:
            continue
    return None
