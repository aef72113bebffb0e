"""Other scales than the stated one, for runs in which catheters lack.

A heart lies up to 10 cm beside the isocentre, makers' spacings differ from those of a type, and some scales are estimates. What
is longer in the image than its description is not found. A smaller scale gives the network a larger picture, in which it separates
electrodes that lie close together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import FrameChains, Segmentation
from fluoromap.reasons import Reason
from fluoromap.segmenter.runs.hypotheses.added_catheters import add_catheters
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

OTHER_SCALES = 1.18, 1.39, 0.85
"""Over the stated one."""

_CONFIRMED = 2
_NEARLY_AS_MUCH = 0.75
"""How much of what the stated scale explains in a few frames another one has to explain to be tried where catheters lack."""
_AS_STATED = 1.05
"""How much more probable than with the stated scale all catheters have to be with another one."""


@dataclass(frozen=True, slots=True)
class UsefulScales:
    """The scales whose catheters count, pixels per mm at the isocentre: each adds some to those before it."""

    px_per_mm: tuple[float, ...]


def useful_scales(
    stated: float,
    catalogue: Catalogue,
    segment: Callable[[float], Segmentation],
    promising: Callable[[Sequence[float], float], Sequence[float]],
) -> UsefulScales:
    """Return the scales that together show most of a run's catheters.

    It is the stated one alone where that shows all or others add nothing. Else the catheters are most probable in this order, see
    :func:`~fluoromap.segmenter.runs.hypotheses.added_catheters.add_catheters`. Where the stated scale shows none, two have to be
    there: contrast medium may lie like one catheter at some scale. Where it shows one that is not listed, there have to be three,
    or six more electrodes: four of an unlisted catheter may lie like a listed one of another size. Where it shows all and one that
    is not listed, the others have to show all without that one, and to make them more probable.

    Parameters
    ----------
    stated : float
        Pixels per mm at the isocentre.
    catalogue : Catalogue
    segment : callable
        Segments the run at a scale.
    promising : callable
        Returns those of some scales that are worth a segmentation: what they explain of a few frames is at least so many times what
        the stated one does.
    """
    found = segment(stated)
    are_all = _usual_catheters(found) >= len(catalogue.catheters)
    if are_all and not _shows_unlisted(found):
        return UsefulScales((stated,))
    others = promising([by * stated for by in OTHER_SCALES], _AS_STATED if are_all else _NEARLY_AS_MUCH)
    tried = {stated: found} | {scale: segment(scale) for scale in others}

    def shows_more(together: Segmentation) -> bool:
        more, catheters = _count_electrodes(together) - _count_electrodes(found), _usual_catheters(together)
        if are_all:
            is_more_probable = expected_electrodes(together.frames) > _AS_STATED * expected_electrodes(found.frames)
            return is_more_probable and catheters >= len(catalogue.catheters) and not _shows_unlisted(together)
        if _shows_unlisted(found) and catheters <= _CONFIRMED and more < MANY_ELECTRODES * len(found.frames):
            return False
        return more > 0 and catheters >= (1 if _count_electrodes(found) else _CONFIRMED)

    useful, most = UsefulScales((stated,)), 0.0
    for first in (scale for scale, other in tried.items() if _count_electrodes(other)):
        scales, together = _together(first, tried, catalogue)
        probable = (_AS_STATED if first == stated else 1.0) * expected_electrodes(together.frames)
        if probable > most and shows_more(together):
            useful, most = UsefulScales(scales), probable
    return useful


def _together(
    first: float, tried: Mapping[float, Segmentation], catalogue: Catalogue
) -> tuple[tuple[float, ...], Segmentation]:
    """Return the scales that add catheters to the first one, and all catheters."""
    scales, found = [first], tried[first]
    for scale, other in tried.items():
        more = add_catheters(found, other, catalogue, scale)
        if more is not found:
            scales.append(scale)
        found = more
    return tuple(scales), found


def _usual_catheters(found: Segmentation) -> float:
    """Return how many chains half of the frames have."""
    return float(np.median([len(entry.chains) for entry in found.frames]))


def _shows_unlisted(found: Segmentation) -> bool:
    return found.diastole is not None and found.diastole.manual_needed is Reason.EXTRA_CATHETER


def _count_electrodes(found: Segmentation) -> int:
    return sum(len(chain.electrodes) for entry in found.frames for chain in entry.chains)


def expected_electrodes(frames: Sequence[FrameChains]) -> float:
    """Return the sum of the probabilities of all electrodes."""
    return sum(float(chain.scores.sum()) for entry in frames for chain in entry.chains)
