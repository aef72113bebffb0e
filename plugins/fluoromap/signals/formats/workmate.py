"""WorkMate Claris (Abbott): one text file for each channel, and perhaps a file with information about the session."""

from __future__ import annotations

import re
from codecs import BOM_UTF8 as BOM
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluoromap.signals.channel_names import described
from fluoromap.signals.recording import MILLIVOLT, Channel, ChannelKind, NotARecording, Recording, Samples, Sources
from fluoromap.signals.sample_table import SampleTable

FORMAT = "WorkMate Claris"
_USUAL_RATE_HZ, _USUAL_NV = 2000.0, 78.0
"""Of files without a header: the recorder's usual rate, and nanovolts of a count."""
_NAME = re.compile(r"(?P<channel>.+?)\.Session (?P<session>\d+) - (?P<page>.+)\.txt", re.IGNORECASE)
_INFORMATION = re.compile(r"Session \d+ Information\.txt", re.IGNORECASE)
_HEAD_BYTES = 2**14
_PIECE = 2**16


@dataclass(frozen=True, slots=True)
class _File:
    """One channel's file."""

    channel: Channel
    table: SampleTable
    gain: float


def recognises(name: str, head: bytes) -> bool:
    """Return whether a file is named as a channel of a WorkMate export."""
    return bool(_NAME.fullmatch(name) or _INFORMATION.fullmatch(name))


def read(sources: Sources) -> Recording:
    """Read the headers of an export's files.

    Raises
    ------
    NotARecording
        When no channel came, or channels of several sessions or pages.
    """
    named = {name: _NAME.fullmatch(name) for name in sources}
    pages = {(found["session"], found["page"]) for found in named.values() if found}
    if not pages:
        raise NotARecording("Only the information of a WorkMate session came; send the files of its channels too.")
    if len(pages) > 1:
        raise NotARecording(f"The files are of {len(pages)} pages of WorkMate sessions; send the files of one page.")
    files = [_file(sources[name], found["channel"]) for name, found in sorted(named.items()) if found]
    counts = tuple(one.table.count_lines() for one in files)
    if len({one.channel.rate_hz for one in files}) > 1:
        rates = ", ".join(sorted({f"{one.channel.rate_hz:g}" for one in files}))
        raise NotARecording(
            f"The channels have different rates ({rates} samples a second); export them with the same rate."
        )
    warnings: tuple[str, ...] = ()
    if len(set(counts)) > 1:
        warnings = (f"The channels have between {min(counts)} and {max(counts)} samples; the shortest counts.",)
    shortest = min(counts)

    def blocks() -> Iterator[tuple[Samples, ...]]:
        with ExitStack():
            streams = [_evenly(one, shortest) for one in files]
            yield from zip(*streams, strict=True)

    channels = tuple(one.channel for one in files)
    return Recording(FORMAT, channels, (shortest,) * len(channels), blocks, None, warnings)


def _evenly(one: _File, count: int) -> Iterator[Samples]:
    """Yield a channel's samples in pieces of one length.

    So channels with long and with short numbers keep together.
    """
    rest = np.zeros(0)
    left = count
    for piece in one.table.pieces():
        rest = np.concatenate([rest, piece[:, 0]])
        while left and len(rest) >= min(_PIECE, left):
            length = min(_PIECE, left)
            yield np.asarray(rest[:length] * one.gain, np.float32)
            rest = rest[length:]
            left -= length


def _file(path: Path, name: str) -> _File:
    entries: dict[str, str] = {}
    start = line = 0
    with path.open("rb") as stream:
        for raw in iter(stream.readline, b""):
            text = raw.removeprefix(BOM).decode("latin-1").strip()
            if re.fullmatch(r"[-+]?\d+(?:\.\d+)?", text):
                break
            start += len(raw)
            line += 1
            key, _, value = text.partition("=")
            entries[" ".join(key.lower().split())] = value.strip()
            if start > _HEAD_BYTES:
                raise NotARecording(f"The file of channel {name} has no samples in its first lines; export it again.")
    rate = _number(entries.get("sample rate")) or _USUAL_RATE_HZ
    resolution = entries.get("channel resolution", "")
    nanovolts = _number(resolution) or _USUAL_NV
    if re.search(r"\d\s*[uµ]V", resolution, re.IGNORECASE):
        nanovolts *= 1000.0
    channel = described(Channel(name, rate, MILLIVOLT, ChannelKind.OTHER))
    return _File(channel, SampleTable(path, start, line + 1, 1, " "), nanovolts * 1e-6)


def _number(text: str | None) -> float | None:
    found = re.search(r"\d+(?:\.\d+)?", text or "")
    return float(found[0]) if found else None
