"""Rows of electrodes that the catalogue does not explain: a longer catheter must not pass for a shorter one of the catalogue."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, BoolArray, Chain, IntArray
from fluoromap.segmenter.kernels import kernel

SURE = 0.5
"""Proposals of this probability have to be explained."""
EVEN_ODDS = 0.0
"""The log-odds of :data:`SURE`."""

_OWN_MM = 1.2
_BESIDE_MM = 1.0
_ROW_CONTINUES = 3
_LEAST_COSINE = 0.85
_LONGEST_STEP = 1.25
_TURNS_ON = 0.75
"""How far a row turns to the next electrodes, as a share of the turn between its halves."""
_ROW, _ROW_STEP_MM = 4, 10.0
_LEAST_STEP = 0.75
"""Distance of a row's next electrode, as a share of the last gap: what is nearer is part of a long tip."""


@dataclass(frozen=True, slots=True, eq=False)
class Onwards:
    """Electrodes in the line of a row, beyond one of its ends in one frame.

    points_uv : (n, 2) pixels, from the row on. as_sure : (n,) whether they are as probable as the row's middle electrode.
    own_px : how far from the electrode of another chain each is one that the chain does not explain.
    """

    frame: int
    points_uv: Array
    as_sure: BoolArray
    own_px: float

    def unexplained_by(self, chains: Sequence[Chain]) -> bool:
        """Return whether other chains leave electrodes unexplained.

        Two have to be left, or the first of them where it is as sure as the row.
        """
        left = np.ones(len(self.points_uv), np.bool_)
        for chain in chains:
            left &= _apart(self.points_uv, chain.pixels_uv, self.own_px)
        return bool(np.count_nonzero(left) > 1 or (left[:1] & self.as_sure[:1]).any())


def onwards(frame: int, row_uv: Array, points_uv: Array, as_sure: BoolArray, px_per_mm: float) -> Onwards:
    """Return the points in the line of a row of electrodes beyond its last one.

    They are no farther apart than the row's electrodes are.

    Parameters
    ----------
    frame : int
    row_uv : (electrodes, 2)
        Pixels.
    points_uv : (n, 2)
        Sure electrodes of the image, pixels; those of the row may be among them.
    as_sure : (n,)
        Whether they are as probable as the row's middle electrode.
    px_per_mm : float
    """
    own_px = _OWN_MM * px_per_mm
    gaps = np.sqrt((np.diff(row_uv, axis=0) ** 2).sum(axis=1))
    apart = _apart(points_uv, row_uv, own_px) & _apart(points_uv, row_uv[-1:], _LEAST_STEP * float(gaps[-1]))
    free = np.flatnonzero(apart)
    line = free[_line_beyond(row_uv, points_uv[free], _LONGEST_STEP * float(gaps.max()))]
    return Onwards(frame, points_uv[line], as_sure[line], own_px)


def unexplained_between(chain: Chain, points_uv: Array, catheter: Catheter, px_per_mm: float) -> int:
    """Count points within the chain that are none of its electrodes.

    They lie on the way from its first electrode to its last.

    Parameters
    ----------
    chain : Chain
    points_uv : (n, 2)
        Sure proposals that no other chain has, pixels. Those on the tip electrode are parts of it.
    catheter : Catheter
    """
    free = points_uv[_apart(points_uv, chain.pixels_uv, _OWN_MM * px_per_mm)]
    free = free[_apart(free, chain.pixels_uv[:1], (0.5 * catheter.tip_mm + _BESIDE_MM) * px_per_mm)]
    if not len(free):
        return 0
    way = np.diff(chain.pixels_uv, axis=0)
    length = np.maximum(np.sqrt((way * way).sum(axis=1)), 1e-9)
    u, v = np.moveaxis(free[:, None] - chain.pixels_uv[:-1], -1, 0)
    along = (u * way[:, 0] + v * way[:, 1]) / length
    beside = np.abs(v * way[:, 0] - u * way[:, 1]) / length
    is_between = (along > 0.0) & (along < length) & (beside < _BESIDE_MM * px_per_mm)
    return int(np.count_nonzero(is_between.any(axis=1)))


def continues(
    chain: Chain, points_uv: Array, catheter: Catheter, px_per_mm: float, least: int = _ROW_CONTINUES
) -> bool:
    """Return whether points go on in the chain's line beyond an end.

    ``least`` or more points are needed, no farther apart than the chain's electrodes are. The line may be straight, or turn on as
    the chain does: electrodes of a loop lie on a circle.

    Parameters
    ----------
    chain : Chain
        All electrodes of the catheter.
    points_uv : (n, 2)
        Sure proposals of the image, pixels; its own electrodes and those of other chains may be among them.
    catheter : Catheter
    least : int
    """
    free = points_uv[_apart(points_uv, chain.pixels_uv, _OWN_MM * px_per_mm)]
    if len(free) < least:
        return False
    way = np.diff(chain.pixels_uv, axis=0)
    seen = float(np.sqrt((way * way).sum(axis=1)).sum())
    step = _LONGEST_STEP * max(catheter.spacing_mm) * seen / sum(catheter.spacing_mm)
    return any(len(_line_beyond(row, free, step)) >= least for row in (chain.pixels_uv, chain.pixels_uv[::-1]))


def _line_beyond(row_uv: Array, points_uv: Array, reach: float) -> IntArray:
    """Return the indices of the points in the line beyond the last of a row.

    The line is straight or turns on as the row does, whichever has more points.
    """
    before = row_uv[-3] if len(row_uv) > 2 else row_uv[-2]
    lines = (_find_onwards(row_uv[-1], origin, points_uv, reach) for origin in (before, _before_turn(row_uv)))
    return max(lines, key=len)


def _before_turn(row: Array) -> Array:
    """Return a point before the end of a row (n, 2).

    A line through both goes on beyond the row as the row turns.
    """
    half = (len(row) + 1) // 2
    first, last = ((points[-1] - points[0]) @ np.array([1.0, 1.0j]) for points in (row[:half], row[-half:]))
    turned = last * np.exp(1j * _TURNS_ON * np.angle(last / first)) if first else last
    point: Array = row[-1] - np.array([turned.real, turned.imag])
    return point


def shows_row(points_uv: Array, px_per_mm: float) -> bool:
    """Return whether four or more points (n, 2) lie in a row.

    The points are sure proposals, and the row is like the electrodes of a catheter.
    """
    reach = _ROW_STEP_MM * px_per_mm
    for first in range(len(points_uv)):
        for second in range(len(points_uv)):
            way = points_uv[second] - points_uv[first]
            if first == second or np.linalg.norm(way) > reach:
                continue
            left = np.delete(points_uv, [first, second], axis=0)
            if 2 + len(_find_onwards(points_uv[second], points_uv[first], left, reach)) >= _ROW:
                return True
    return False


def _find_onwards(at: Array, before: Array, left: Array, reach: float) -> IntArray:
    """Return the indices of the points in a line past ``at``.

    They are in their order. The line comes from ``before``. Each point is at most ``reach`` from the last.
    """
    order = np.empty(len(left), np.int64)
    count = _find_in_line(at[0], at[1], before[0], before[1], left, np.ones(len(left), np.bool_), reach, order)
    return order[:count]


@kernel("f8, f8, f8, f8, f8[:,::1], b1[::1], f8, i8[::1]", fastmath=False)
def _find_in_line(at_u, at_v, before_u, before_v, left, is_left, reach, order):  # type: ignore[no-untyped-def]  # pragma: no cover
    for count in range(left.shape[0]):
        way_u, way_v = at_u - before_u, at_v - before_v
        length = max(math.sqrt(way_u * way_u + way_v * way_v), 1e-9)
        nearest, least = -1, np.inf
        for point in range(left.shape[0]):
            du, dv = left[point, 0] - at_u, left[point, 1] - at_v
            away = max(math.sqrt(du * du + dv * dv), 1e-9)
            onwards = (du * way_u + dv * way_v) / length
            if is_left[point] and away <= reach and onwards >= _LEAST_COSINE * away and away < least:
                nearest, least = point, away
        if nearest < 0:
            return count
        is_left[nearest] = False
        order[count] = nearest
        before_u, before_v, at_u, at_v = at_u, at_v, left[nearest, 0], left[nearest, 1]
    return left.shape[0]


def not_on(points_uv: Array, chains: Sequence[Chain], px_per_mm: float) -> Array:
    """Return the points that are no electrode of these chains, (k, 2)."""
    if not chains:
        return points_uv
    taken = np.concatenate([chain.pixels_uv for chain in chains])
    free: Array = points_uv[_apart(points_uv, taken, _OWN_MM * px_per_mm)]
    return free


def _apart(points_uv: Array, taken_uv: Array, distance: float) -> BoolArray:
    if not len(points_uv):
        return np.zeros(0, np.bool_)
    difference = points_uv[:, None] - taken_uv
    away: BoolArray = np.sqrt((difference * difference).sum(axis=2).min(axis=1)) > distance
    return away
