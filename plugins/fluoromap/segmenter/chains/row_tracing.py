"""Rows of catheters with many electrodes, some of which were not proposed.

A search from each end follows the rows that are most probable so far. They take candidates where the next electrode is expected,
and step over electrodes that they do not meet. Where the catheter turns through the viewing direction, its electrodes merge: one
candidate stands for several.
"""

from __future__ import annotations

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.picture.field_mask import are_in
from fluoromap.segmenter.shape.limits import LONGEST, TURNING_ELECTRODES
from fluoromap.segmenter.shape.row_shape import next_place, smooth_places
from fluoromap.segmenter.shape.spacings import searched_spacing_px

_FOLLOWED = 150
_MOST_MISSING = 0.34
_MISSING_IN_A_ROW = 2
_GATE = 2.5
_MISSING_PRICE = 2.5
_MOST_MERGED, _MERGED_PRICE, _MERGED_PX = 3, 2.0, 1.5


def trace_rows(
    points_uv: Array, weights: Array, catheter: Catheter, px_per_mm: float, most: int, inside: BoolArray
) -> tuple[IntArray, Array, IntArray]:
    """Return the best rows of candidates.

    Parameters
    ----------
    points_uv : (n, 2)
        Candidates, pixels.
    weights : (n,)
        Their :func:`~fluoromap.segmenter.chains.linking.evidence`.
    catheter : Catheter
    px_per_mm : float
        At the isocentre.
    most : int
        At most so many rows are returned.
    inside : (rows, columns) bool
        The field. Up to half of the electrodes may lie outside it.

    Returns
    -------
    rows : (k, electrodes)
        Index of the candidate of each electrode from the tip on, -1 where one is missing; best first.
    places_uv : (k, electrodes, 2)
        Where the electrodes are expected.
    merged : (k, electrodes)
        For a missing electrode, the candidate of another electrode that covers it, -1 where there is none.
    """
    from_tip, score_from_tip = _rows_from_one_end(points_uv, weights, catheter, px_per_mm, inside, 1)
    from_end, score_from_end = _rows_from_one_end(points_uv, weights, catheter, px_per_mm, inside, -1)
    rows, first = np.unique(np.concatenate([from_tip, from_end[:, ::-1]]), axis=0, return_index=True)
    scores = np.concatenate([score_from_tip, score_from_end])[first]
    rows = rows[np.argsort(-scores, kind="stable")[:most]]
    merged = np.where(rows < -1, -2 - rows, -1)
    seen_at = points_uv[np.maximum(rows, merged)]
    variance = np.where(rows >= 0, 1.0, np.where(merged >= 0, _MERGED_PX**2, np.inf))
    places = smooth_places(seen_at, catheter.spacing_mm, catheter.curvature_per_mm, variance, px_per_mm)
    return np.maximum(rows, -1), places, merged


def _rows_from_one_end(
    points: Array, weights: Array, catheter: Catheter, px_per_mm: float, inside: BoolArray, way: int
) -> tuple[IntArray, Array]:
    """Return rows and their scores, in the order of the search.

    The search goes from the tip on for ``way`` 1, towards it for -1. In a row, -1 is a missing electrode and -2 - c one that
    candidate c covers, which has another electrode.
    """
    longest_px = LONGEST * searched_spacing_px(catheter, px_per_mm)[::way]
    electrodes, count = catheter.electrodes, len(points)
    most_missing = int(_MOST_MISSING * electrodes)
    most_merged = most_missing if electrodes >= TURNING_ELECTRODES else 0
    rows, uses = np.arange(count)[:, None], np.eye(count, dtype=np.int64)
    places, scores = points[:, None], weights
    missing, merged, in_a_row, beyond = np.zeros((4, count), np.int64)
    for at in range(1, electrodes):
        coefficients, sd_mm = next_place(catheter.spacing_mm[::way], catheter.curvature_per_mm, at)
        expected = np.einsum("k,rkx->rx", coefficients, places)
        variance = (sd_mm * px_per_mm) ** 2
        from_expected = points - expected[:, None]
        square = from_expected[..., 0] ** 2 + from_expected[..., 1] ** 2
        from_last = points - places[:, -1:]
        is_taken = uses > 0
        spread = np.where(is_taken, variance + _MERGED_PX**2, variance)
        may_miss = missing < most_missing
        # An end that another electrode covers is no end of a row.
        may_merge = may_miss & (merged < most_merged) & (at < electrodes - 1)
        allowed = (square < _GATE**2 * spread) & (uses < _MOST_MERGED) & (may_merge[:, None] | ~is_taken)
        allowed &= from_last[..., 0] ** 2 + from_last[..., 1] ** 2 < longest_px[at - 1] ** 2
        # What speaks for a candidate counts once.
        worth = np.where(is_taken, -_MERGED_PRICE, weights) - 0.5 * square / spread
        is_beyond = ~are_in(inside, expected)
        may_miss &= in_a_row < _MISSING_IN_A_ROW
        may_miss |= is_beyond & (2 * (missing + beyond) < electrodes)
        of_row, candidate = np.nonzero(np.column_stack([allowed, may_miss]))
        steps = np.column_stack([worth, np.where(is_beyond, 0.0, -_MISSING_PRICE)])
        total = scores[of_row] + steps[of_row, candidate]
        if len(total) > _FOLLOWED:
            best = np.argpartition(-total, _FOLLOWED)[:_FOLLOWED]
            of_row, candidate, total = of_row[best], candidate[best], total[best]
        scores = total
        is_seen = candidate < count
        taken = is_seen & (uses[of_row, np.minimum(candidate, count - 1)] > 0)
        share = np.where(taken, variance / (variance + _MERGED_PX**2), is_seen)[:, None]
        seen_at = points[np.minimum(candidate, count - 1)]
        places = np.concatenate(
            [places[of_row], (expected[of_row] + share * (seen_at - expected[of_row]))[:, None]], axis=1
        )
        entry = np.where(taken, -2 - candidate, np.where(is_seen, candidate, -1))
        rows = np.column_stack([rows[of_row], entry])
        uses = uses[of_row]
        uses[np.flatnonzero(is_seen), candidate[is_seen]] += 1
        is_beyond = is_beyond[of_row] & ~is_seen
        beyond = beyond[of_row] + is_beyond
        lacking = ~is_seen & ~is_beyond
        merged = merged[of_row] + taken
        missing = missing[of_row] + (taken | lacking)
        in_a_row = np.where(lacking, in_a_row[of_row] + 1, 0)
    return rows, scores
