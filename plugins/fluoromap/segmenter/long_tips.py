"""Tip electrodes so long that each of their ends looks like an electrode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.linking import ShaftImage
from fluoromap.segmenter.proposals import Proposals, log_odds

_END = 0.31
"""Distance of the ends that are found from the middle of a tip, as a share of its length."""
_SHORTEST, _LONGEST = 0.45, 1.15
_LEAST_PROBABILITY = 0.2
_AS_DARK = 0.85
_MIDDLE_SD_MM = 0.4
_MOST_LOG_ODDS, _MOST = 6.0, 24
_UNLIKE, _LEAST_COSINE = 1.3, 0.9


@dataclass(frozen=True, slots=True, eq=False)
class TipMiddles:
    """Middles between two proposals that can be the ends of one long tip.

    ends : (n, 2), the indices of the two proposals.
    """

    proposals: Proposals
    ends: IntArray

    def __len__(self) -> int:
        return len(self.proposals)


def tip_middles(proposed: Proposals, catheters: Sequence[Catheter], image: ShaftImage) -> TipMiddles:
    """Return the middles of proposals that can be the ends of a long tip.

    Between the ends of a tip the image is as dark as at the ends; between two rings it shows the shaft only.
    """
    lengths = [2.0 * _END * catheter.tip_mm * image.px_per_mm for catheter in catheters if catheter.has_long_tip]
    points = proposed.points_uv
    likely = np.flatnonzero(proposed.probability >= _LEAST_PROBABILITY) if lengths else np.zeros(0, np.int64)
    one, other = (likely[side] for side in np.triu_indices(len(likely), 1))
    way = points[other] - points[one]
    apart = np.linalg.norm(way, axis=1)
    fits = np.zeros(len(one), np.bool_)
    for length in lengths:
        fits |= (apart >= _SHORTEST * length) & (apart <= _LONGEST * length)
    one, other, way, apart = one[fits], other[fits], way[fits], apart[fits]
    middle = 0.5 * (points[one] + points[other])
    across = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.maximum(apart, 1e-9)[:, None] * image.side_px
    at_ends = np.minimum(_depth(points[one], across, image), _depth(points[other], across, image))
    dark = _depth(middle, across, image) >= np.maximum(_AS_DARK * at_ends, image.clear)
    odds = np.minimum(log_odds(proposed.probability[one]) + log_odds(proposed.probability[other]), _MOST_LOG_ODDS)
    best = np.flatnonzero(dark)[np.argsort(-odds[dark], kind="stable")[:_MOST]]
    one, other, middle, odds = one[best], other[best], middle[best], odds[best]
    spread = (_MIDDLE_SD_MM * image.px_per_mm) ** 2 * np.eye(2)
    return TipMiddles(
        Proposals(middle, 1.0 / (1.0 + np.exp(-odds)), np.tile(spread, (len(middle), 1, 1))),
        np.stack([one, other], axis=1),
    )


def are_ends_of_tip(apart_uv: Array, first_gap_uv: Array, catheter: Catheter) -> BoolArray:
    """Return whether places can be the ends of a chain's tip, (n,).

    The ends lie in the direction of the next electrode, and are foreshortened as its distance is.

    Parameters
    ----------
    apart_uv : (n, 2)
        From end to end, pixels.
    first_gap_uv : (n, 2)
        From the middle of the tip to the next electrode, pixels.
    catheter : Catheter
    """
    apart, gap = np.linalg.norm(apart_uv, axis=1), np.linalg.norm(first_gap_uv, axis=1)
    along = np.abs((apart_uv * first_gap_uv).sum(axis=1))
    shortening = apart / (2.0 * _END * catheter.tip_mm)
    of_gap = np.maximum(gap / catheter.spacing_mm[0], 1e-9)
    alike: BoolArray = (shortening >= of_gap / _UNLIKE) & (shortening <= of_gap * _UNLIKE)
    alike &= along >= _LEAST_COSINE * apart * gap
    return alike


def with_long_tip(values_at: Callable[[Array], Array], chain_uv: Array, catheter: Catheter) -> Array:
    """Return the values of a chain's electrodes, (electrodes,).

    A long tip has the value of its weaker end where that is higher.
    """
    values: Array = np.array(values_at(chain_uv))
    if catheter.has_long_tip:
        values[0] = max(values[0], values_at(_ends(chain_uv, catheter)).min())
    return values


def _ends(chain_uv: Array, catheter: Catheter) -> Array:
    """Return the places of the ends that are found, (2, 2)."""
    way = (chain_uv[1] - chain_uv[0]) / catheter.spacing_mm[0]
    ends: Array = chain_uv[0] + np.array([[-1.0], [1.0]]) * (_END * catheter.tip_mm) * way
    return ends


def _depth(points_uv: Array, across: Array, image: ShaftImage) -> Array:
    """Return how much darker points are than the darker side beside them, (n,)."""
    scale = 1.0 / image.reduction
    last = np.array(image.smooth.shape[::-1]) - 1
    sides = [
        image.smooth[cell[:, 1], cell[:, 0]].astype(np.float64)
        for cell in (
            np.clip(np.rint((points_uv + side * across + 0.5) * scale - 0.5), 0, last).astype(np.int64)
            for side in (-1.0, 0.0, 1.0)
        )
    ]
    depth: Array = np.minimum(sides[0], sides[2]) - sides[1]
    return depth
