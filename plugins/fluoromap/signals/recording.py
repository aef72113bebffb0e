"""A recording of an EP recorder: its channels, and their samples piece by piece."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, time
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.float32]
"""Samples of one channel, (n,), in the channel's unit."""
Sources = Mapping[str, Path]
"""The files of an export by the names under which the recorder wrote them."""

MILLIVOLT = "mV"


class ChannelKind(StrEnum):
    """What a channel measures."""

    BIPOLAR = "bipolar"
    UNIPOLAR = "unipolar"
    SURFACE = "surface"
    STIMULUS = "stimulus"
    OTHER = "other"


class NotARecording(ValueError):
    """The files are no recording that can be read; the message says what is wrong, where, and what to do."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of a recording.

    Parameters
    ----------
    name : str
        As the recorder wrote it.
    rate_hz : float
        Samples a second.
    unit : str or None
        ``mV``; another unit as written; None where the amplitude is not calibrated.
    kind : ChannelKind
    catheter : str or None
        The catheter that the name gives; None for a surface lead and for a name without one.
    electrodes : tuple of int
        Numbers of its electrodes where the name has them, the first positive; 1 is the tip.
    position : str or None
        ``d``, ``m`` or ``p`` where the name says distal, middle or proximal instead of numbers.
    low_hz, high_hz : float or None
        Band of the recorder's filter.
    """

    name: str
    rate_hz: float
    unit: str | None
    kind: ChannelKind
    catheter: str | None = None
    electrodes: tuple[int, ...] = ()
    position: str | None = None
    low_hz: float | None = None
    high_hz: float | None = None

    def __post_init__(self) -> None:
        if not self.rate_hz > 0:
            raise ValueError(f"channel {self.name!r} has {self.rate_hz} samples a second; give a rate above 0")


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The channels of one recording.

    Parameters
    ----------
    format : str
        Name of the recorder's format, for people.
    channels : tuple of Channel
    samples : tuple of int
        Number of samples of each channel.
    started : datetime, time or None
        Begin of the recording by the recorder's clock; some formats have no date.
    blocks : callable
        Returns an iterator over successive pieces of the recording. Each piece has the samples of every channel in the order of
        ``channels``; the pieces of all channels cover the same time. Memory does not grow with the recording.
    """

    format: str
    channels: tuple[Channel, ...]
    samples: tuple[int, ...]
    blocks: Callable[[], Iterator[tuple[Samples, ...]]]
    started: datetime | time | None = None
    warnings: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        if not self.channels:
            raise NotARecording("The recording has no channels; export it again with the channels that you need.")
        if len(self.samples) != len(self.channels):
            raise ValueError(f"{len(self.samples)} lengths are given for {len(self.channels)} channels")

    @property
    def duration_ms(self) -> float:
        """Length of the longest channel."""
        return max(1000.0 * count / channel.rate_hz for count, channel in zip(self.samples, self.channels, strict=True))

    def all_samples(self) -> tuple[Samples, ...]:
        """Return all samples of each channel: for short recordings only.

        Raises
        ------
        NotARecording
            When the samples are damaged.
        """
        pieces = list(self.blocks())
        return tuple(np.concatenate([piece[k] for piece in pieces]) for k in range(len(self.channels)))
