"""CARTO 3: the electrograms of one point, ``..._ECG_Export.txt``, 2500 samples at 1000 a second."""

from __future__ import annotations

import re
from codecs import BOM_UTF8 as BOM
from collections.abc import Iterator

import numpy as np

from fluoromap.signals.channel_names import described
from fluoromap.signals.recording import MILLIVOLT, Channel, ChannelKind, NotARecording, Recording, Samples, Sources
from fluoromap.signals.sample_table import SampleTable

FORMAT = "CARTO 3"
RATE_HZ = 1000.0
_LINES_OF_HEADER = 10
_COLUMN = re.compile(r"(?P<name>\S+?)\(\d+\)")


def recognises(name: str, head: bytes) -> bool:
    """Return whether a file begins as an export of a CARTO point."""
    return head.removeprefix(BOM).lstrip().startswith(b"ECG_Export")


def read(sources: Sources) -> Recording:
    """Read the header of an export.

    Raises
    ------
    NotARecording
        When it names no gain or no channels.
    """
    (path,) = sources.values()
    gain: float | None = None
    columns: list[str] = []
    start = line = 0
    with path.open("rb") as stream:
        while not columns and line < _LINES_OF_HEADER:
            raw = stream.readline(2**16)
            start, line = start + len(raw), line + 1
            text = raw.decode("latin-1")
            if stated := re.search(r"gain[^=]*=\s*([\d.]+)", text, re.IGNORECASE):
                gain = float(stated[1])
            names = [found["name"] for found in _COLUMN.finditer(text)]
            columns = names if len(names) == len(text.split()) else []
    if gain is None:
        raise NotARecording("The export states no gain; export the point again.")
    if not columns:
        raise NotARecording(f"None of the first {_LINES_OF_HEADER} lines names the channels; export the point again.")
    channels = tuple(described(Channel(name, RATE_HZ, MILLIVOLT, ChannelKind.OTHER)) for name in columns)
    table = SampleTable(path, start, line + 1, len(channels), " ")
    count, factor = table.count_lines(), gain

    def blocks() -> Iterator[tuple[Samples, ...]]:
        for piece in table.pieces():
            yield tuple(np.asarray(piece * factor, np.float32).T)

    return Recording(FORMAT, channels, (count,) * len(channels), blocks)
