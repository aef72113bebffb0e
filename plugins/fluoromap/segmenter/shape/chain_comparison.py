"""Comparison of chains: how far apart two of them lie, and whether they can be one catheter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

_SAME_PX, _DISPLACED_PX = 1.5, 4.0
_SHARED_AT_LEAST = 0.5

SAME_PLACE_PX = 4.0
"""Distance below which electrodes of two chains are one."""
_DISPLACED_WEIGHT = 0.5


def chain_distance(one: Chain, other: Chain, shift: Array | None = None) -> tuple[float, float]:
    """Return mean shift and largest remaining distance between two chains, pixels.

    Only electrodes that both chains have are compared. Both numbers are infinite where there are none. The worst fifth of six or
    more electrodes counts half: clutter and merged pairs displace some of a long catheter.
    """
    mine, theirs = _common_places(one, other)
    count = len(mine)
    if not count:
        return math.inf, math.inf
    du, dv = (0.0, 0.0) if shift is None else shift.tolist()
    # NumPy takes longer for each of a dozen steps than for numbers of so few electrodes.
    moved = [
        (u - own_u - du, v - own_v - dv) for (own_u, own_v), (u, v) in zip(mine.tolist(), theirs.tolist(), strict=True)
    ]
    mean_u, mean_v = sum(u for u, _ in moved) / count, sum(v for _, v in moved) / count
    away = sorted(math.sqrt((u - mean_u) ** 2 + (v - mean_v) ** 2) for u, v in moved)
    farthest = away[-1]
    if count >= MANY_ELECTRODES:
        worst = count // 5
        farthest = max(away[-worst - 1], _DISPLACED_WEIGHT * farthest)
    return math.sqrt(mean_u**2 + mean_v**2), farthest


def kind_overlap(one: Chain, other: Chain) -> float:
    """Return how well the kinds of two chains agree.

    0 : they cannot be the same catheter. 1 : their probabilities agree as far as they can.
    """
    theirs = dict(other.kinds)
    agreement = sum(probability * theirs.get(name, 0.0) for name, probability in one.kinds)
    squares = [sum(probability**2 for _, probability in chain.kinds) for chain in (one, other)]
    return agreement / max(*squares, 1e-9)


def mean_shift(one: Chain, other: Chain) -> Array:
    """Return the mean shift (2,) between two chains, pixels; 0 where none is shared."""
    mine, theirs = _common_places(one, other)
    if not len(mine):
        return np.zeros(2)
    moved: Array = (theirs - mine).sum(axis=0) / len(mine)
    return moved


def _common_places(one: Chain, other: Chain) -> tuple[Array, Array]:
    """Return the places in two chains of the electrodes that both have, (n, 2)."""
    if one.electrodes == other.electrodes:
        return one.pixels_uv, other.pixels_uv
    common = sorted(set(one.electrodes) & set(other.electrodes))
    mine, theirs = (chain.pixels_uv[[chain.electrodes.index(number) for number in common]] for chain in (one, other))
    return mine, theirs


def overlaps(chain: Chain, others: Sequence[Chain]) -> bool:
    """Return whether two or more electrodes lie on electrodes of another chain."""
    return any(count_shared(chain, other) >= 2 for other in others)


def count_shared(chain: Chain, other: Chain) -> int:
    """Count the electrodes of a chain that lie on electrodes of another."""
    left, upper, right, lower = chain.extent_px
    other_left, other_upper, other_right, other_lower = other.extent_px
    if max(left - other_right, other_left - right, upper - other_lower, other_upper - lower) >= SAME_PLACE_PX:
        return 0
    apart = chain.pixels_uv[:, None, :] - other.pixels_uv[None, :, :]
    return int(np.count_nonzero((apart * apart).sum(axis=2).min(axis=1) < SAME_PLACE_PX**2))


def reverse(chain: Chain) -> Chain:
    """Return the same chain with its tip at the other end."""
    return replace(chain.from_other_end(chain.electrodes[-1]), electrodes=chain.electrodes)


def is_same_shape(points_uv: Array, others_uv: Array) -> bool:
    """Return whether two chains have the same shape.

    Both are (n, 2), of the same electrodes. A common shift does not count.
    """
    same, _ = compare_shapes(points_uv[None], others_uv[None])
    return bool(same[0, 0])


def compare_shapes(places: Array, others: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which pairs have one shape, and which differ in some electrodes.

    Both are (chains, others). Two chains differ in some electrodes where half of them agree after the median shift.
    """
    # Electrodes come first: NumPy reduces long stretches of memory fast. (electrodes, 2, chains, others).
    mine, theirs = (np.ascontiguousarray(np.moveaxis(side, 0, -1)) for side in (places, others))
    difference = mine[..., :, None] - theirs[..., None, :]
    shared = np.isfinite(difference[:, 0])
    count = shared.sum(axis=0)
    # A sort puts NaN last.
    middle = (np.maximum(count - 1, 0) // 2)[None, None]
    rest = difference - np.take_along_axis(np.sort(difference, axis=0), middle, axis=0)
    away = np.sqrt(rest[:, 0] ** 2 + rest[:, 1] ** 2)
    farthest = np.where(shared, away, 0.0).max(axis=0)
    agreeing = (away <= _SAME_PX).sum(axis=0)
    enough = count >= _SHARED_AT_LEAST * places.shape[1]
    return enough & (farthest < _DISPLACED_PX), enough & (farthest >= _DISPLACED_PX) & (2 * agreeing >= count)
