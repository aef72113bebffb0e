"""Input and result of a segmenter."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts.arrays import Array, frozen
from fluoromap.reasons import Reason

View = Literal["a", "b"]


class FrameSource(Protocol):
    """The frames of one run, decoded one at a time.

    Indexing and iteration can be repeated.
    """

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> NDArray[np.generic]:
        """Return the stored pixels of frame ``index`` (from 0).

        The array has shape (rows, columns) and an unsigned integer type.
        """

    def __iter__(self) -> Iterator[NDArray[np.generic]]: ...


@dataclass(frozen=True, slots=True)
class Shutter:
    """The exposed part of the image, from the shutter or collimator attributes.

    rectangle : (left, right, upper, lower) edges; circle : (centre_u, centre_v, radius); polygon : vertices (u, v); all in
    pixels.
    The field is the intersection of all given shapes.
    """

    rectangle: tuple[float, float, float, float] | None = None
    circle: tuple[float, float, float] | None = None
    polygon: tuple[tuple[float, float], ...] | None = None


@dataclass(frozen=True, slots=True)
class PixelFacts:
    """The meaning of the stored pixel values.

    logarithmic : the logarithm was already applied (PixelIntensityRelationship LOG, DISP or DRM).
    bits_stored : significant bits. monochrome1 : high values are dark, as in MONOCHROME1, and must be inverted first.
    """

    logarithmic: bool
    bits_stored: int
    monochrome1: bool
    shutter: Shutter | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """One cine as a segmenter gets it.

    frames : decoded one at a time. frame_times_ms : (n,), from the first frame on.
    px_per_mm : at the isocentre. r_wave_frames : frames with R waves, where the file has them. content : hash of the file with
    the frames; None where there is no file.
    """

    frames: FrameSource
    frame_times_ms: Array
    px_per_mm: float
    pixels: PixelFacts
    r_wave_frames: tuple[int, ...] = ()
    content: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame_times_ms", frozen(self.frame_times_ms, (len(self.frames),), "frame_times_ms"))
        if not self.px_per_mm > 0:
            raise ValueError(f"px_per_mm is {self.px_per_mm}; it must be positive")


@dataclass(frozen=True, eq=False)
class Chain:
    """The electrodes of one catheter in one image.

    electrodes : their numbers, 1 = tip, ascending; a chain set by hand may have only some.
    pixels_uv : (m, 2). covariance_px2 : (m, 2, 2). scores : (m,), contrast over noise.
    kinds : catheter name -> probability (the sum is at most 1); look-alikes share theirs.
    track : chains of one run with the same track number are the same catheter in different frames; -1 without a track.
    manual : set by hand (then ``kinds`` has one name with probability 1).
    tip_odds : log-odds that the numbers begin at the catheter's tip and not at its other end; None where that is no question.
    """

    electrodes: tuple[int, ...]
    pixels_uv: Array
    covariance_px2: Array
    scores: Array
    kinds: tuple[tuple[str, float], ...]
    track: int = -1
    manual: bool = False
    tip_odds: float | None = None

    def __post_init__(self) -> None:
        m = len(self.electrodes)
        if m < 1 or list(self.electrodes) != sorted(set(self.electrodes)) or self.electrodes[0] < 1:
            raise ValueError(f"electrodes are {self.electrodes}; they must be different numbers from 1 on, ascending")
        object.__setattr__(self, "pixels_uv", frozen(self.pixels_uv, (m, 2), "pixels_uv"))
        object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, (m, 2, 2), "covariance_px2"))
        object.__setattr__(self, "scores", frozen(self.scores, (m,), "scores"))
        if sum(probability for _, probability in self.kinds) > 1 + 1e-6:
            raise ValueError(f"probabilities of kinds {self.kinds} add up to more than 1")
        if self.tip_odds is not None and not math.isfinite(self.tip_odds):
            raise ValueError(f"tip_odds is {self.tip_odds}; it must be finite, or None")

    @functools.cached_property
    def extent_px(self) -> tuple[float, float, float, float]:
        """Left, upper, right and lower edge of the electrodes' places."""
        (left, upper), (right, lower) = self.pixels_uv.min(axis=0).tolist(), self.pixels_uv.max(axis=0).tolist()
        return left, upper, right, lower

    def on_track(self, track: int) -> Chain:
        """Return the same chain with another track number."""
        # The other fields were checked when this chain was made, and tracking renumbers every chain of a run.
        chain = copy.copy(self)
        object.__setattr__(chain, "track", track)
        return chain

    def from_other_end(self, electrodes: int) -> Chain:
        """Return the chain of a catheter with so many electrodes, numbered from the other end."""
        return replace(
            self,
            electrodes=tuple(electrodes + 1 - number for number in reversed(self.electrodes)),
            pixels_uv=self.pixels_uv[::-1],
            covariance_px2=self.covariance_px2[::-1],
            scores=self.scores[::-1],
            tip_odds=None if self.tip_odds is None else -self.tip_odds,
        )

    @property
    def likely_name(self) -> str:
        """Name of the catheter that this most likely is."""
        return max(self.kinds, key=lambda kind: kind[1])[0]

    def probability(self, catheter: str) -> float:
        """Return the probability that this is ``catheter``."""
        return dict(self.kinds).get(catheter, 0.0)


@dataclass(frozen=True, slots=True)
class FrameChains:
    """All chains of one image.

    ``manual_needed`` is the reason why there are none, or why they are uncertain.
    """

    frame: int
    chains: tuple[Chain, ...]
    manual_needed: Reason | None = None


@dataclass(frozen=True, eq=False)
class Segmentation:
    """A segmenter's result for one run.

    frames : one entry per frame of the run, in order.
    diastole : chains in the mean of the quiet frames round diastole; its ``frame`` is the middle one of them. None
    where there is no quiet stretch: then single frames are used.
    diastole_frames : the averaged frames, ascending.
    motion : (n,) change of the image from the previous frame, low-passed, arbitrary unit; the first value repeats the
    second.
    frame_times_ms, r_wave_frames : those of the run, for phase matching.
    """

    frames: tuple[FrameChains, ...]
    diastole: FrameChains | None
    diastole_frames: tuple[int, ...]
    motion: Array
    frame_times_ms: Array
    r_wave_frames: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.frames)
        if [entry.frame for entry in self.frames] != list(range(n)):
            raise ValueError("frames must hold every frame of the run in order")
        object.__setattr__(self, "motion", frozen(self.motion, (n,), "motion"))
        object.__setattr__(self, "frame_times_ms", frozen(self.frame_times_ms, (n,), "frame_times_ms"))


@dataclass(frozen=True, slots=True, eq=False)
class Preview:
    """Chains of one frame, for showing only.

    px_per_mm : scale at the isocentre, None where neither the geometry nor the catalogue gives one; then there are no chains.
    scale_found : whether the scale was found from the catalogue and not measured; it is right to about 20 %.
    inverted : whether the grey levels were inverted although the header does not say so.
    """

    chains: tuple[Chain, ...]
    px_per_mm: float | None
    scale_found: bool
    inverted: bool


Marks = Mapping[int, tuple[Chain, ...]]
"""Chains set by hand: frame -> the chains of that frame."""
