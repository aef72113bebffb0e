"""Partial results of a run: answers that a later segmentation of the same run uses again."""

from __future__ import annotations

from dataclasses import dataclass

from fluoromap.contracts import Array, Chain, FrameChains


@dataclass(frozen=True, eq=False)
class RunDetections:
    """The chains of a run's images, each found by itself and without any marks.

    frames : one entry a frame. motion : (n,), see :class:`~fluoromap.contracts.Segmentation`. mean : chains of the mean of the
    frames ``averaged`` round diastole.
    """

    frames: tuple[FrameChains, ...]
    motion: Array
    averaged: tuple[int, ...]
    mean: FrameChains


@dataclass(frozen=True, eq=False)
class RunTracks:
    """The tracked chains of a run without any marks, one entry a frame."""

    frames: tuple[FrameChains, ...]


@dataclass(frozen=True, eq=False)
class FoundAgain:
    """The answer of :meth:`Detector.find_again`."""

    chain: Chain | None


@dataclass(frozen=True, eq=False)
class FoundMoving:
    """The answer of :meth:`Detector.find_moving`."""

    chains: tuple[Chain, ...]


@dataclass(frozen=True, eq=False)
class ObliquePlaces:
    """The answer of :func:`~fluoromap.segmenter.places.oblique_places.place_obliquely` for a frame."""

    chains: tuple[Chain, ...]


@dataclass(frozen=True, slots=True)
class RunLag:
    """The answer of :func:`~fluoromap.segmenter.picture.lag.measure_lag`."""

    lag: float


@dataclass(frozen=True, slots=True)
class ExtraCatheter:
    """The answer of :meth:`Detector.shows_extra_catheter` for the mean image."""

    is_shown: bool
