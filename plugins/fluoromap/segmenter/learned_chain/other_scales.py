"""Other scales than the stated one, for runs in which catheters lack.

A heart lies up to 10 cm beside the isocentre, makers' spacings differ from those of a type, and some scales are estimates. What
is longer in the image than its description is not found. A smaller scale gives the network a larger picture, in which it separates
electrodes that lie close together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, FrameChains, Segmentation
from fluoromap.reasons import Reason
from fluoromap.segmenter.chain_search import MANY_ELECTRODES

OTHER_SCALES = 1.18, 0.85
"""Over the stated one."""

_BESIDE_MM = 1.5
_CONFIRMED = 2
_LEAST_KEPT = 0.8


@dataclass(frozen=True, slots=True)
class ChosenScale:
    """The scale at which a run is segmented, pixels per mm at the isocentre."""

    px_per_mm: float


def choose_scale(
    stated: float,
    catalogue: Catalogue,
    segment: Callable[[float], Segmentation],
    promising: Callable[[Sequence[float]], Sequence[float]],
) -> ChosenScale:
    """Return the scale that explains most electrodes of a run.

    It is the stated one where that shows all catheters. Where it shows none, another one has to show two: contrast medium may lie
    like one catheter at some scale. Else another one has to keep those that it shows. Where it shows one that is not listed,
    another scale has to show three, or six more electrodes: four of an unlisted catheter may lie like a listed one of another size.

    Parameters
    ----------
    stated : float
        Pixels per mm at the isocentre.
    catalogue : Catalogue
    segment : callable
        Segments the run at a scale.
    promising : callable
        Returns those of some scales that are worth a segmentation.
    """
    best, found = stated, segment(stated)
    if _usual_catheters(found) >= len(catalogue.catheters):
        return ChosenScale(stated)
    least = 1 if _count_electrodes(found) else _CONFIRMED
    has_unlisted = _shows_unlisted(found)
    for scale in promising([factor * stated for factor in OTHER_SCALES]):
        other = segment(scale)
        more = _count_electrodes(other) - _count_electrodes(found)
        if more <= 0 or _usual_catheters(other) < least:
            continue
        if has_unlisted and _usual_catheters(other) <= _CONFIRMED and more < MANY_ELECTRODES * len(found.frames):
            continue
        if _share_kept(found, other, _BESIDE_MM * scale) < _LEAST_KEPT:
            continue
        best, found = scale, other
    return ChosenScale(best)


def _usual_catheters(found: Segmentation) -> float:
    """Return how many chains half of the frames have."""
    return float(np.median([len(entry.chains) for entry in found.frames]))


def _shows_unlisted(found: Segmentation) -> bool:
    return found.diastole is not None and found.diastole.manual_needed is Reason.EXTRA_CATHETER


def _count_electrodes(found: Segmentation) -> int:
    return sum(len(chain.electrodes) for entry in found.frames for chain in entry.chains)


def _share_kept(found: Segmentation, other: Segmentation, reach_px: float) -> float:
    """Return the share of the found electrodes that the other segmentation has.

    It is 1 where none is found.
    """
    frames = zip(found.frames, other.frames, strict=True)
    away = np.concatenate([_away(_places(entry), _places(after)) for entry, after in frames])
    return float(np.mean(away <= reach_px)) if len(away) else 1.0


def _places(entry: FrameChains) -> Array:
    return np.concatenate([np.zeros((0, 2)), *(chain.pixels_uv for chain in entry.chains)])


def _away(points_uv: Array, from_uv: Array) -> Array:
    """Return the distance of each point to the nearest of others, (n,), infinite without others."""
    nearest: Array = np.linalg.norm(points_uv[:, None] - from_uv, axis=2).min(axis=1, initial=np.inf)
    return nearest
