"""Chains of catheters with many electrodes, some of which were not proposed.

Every pair of neighbouring candidates starts a trace. It runs along the row both ways, takes the candidates that it meets where the
next electrode is expected, and steps over the electrodes that it does not meet.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.chain_search import LONGEST, SHORTEST

_MOST_SEEDS = 45
_MOST_MISSING = 0.34
_MISSING_IN_A_ROW = 2
_GATE, _GATE_PX = 0.33, 1.5
_MISSING_PRICE = 1.5
_KEPT_BEND = 0.8
"""Share of the last bend, for its length, that is expected to go on."""
_MOST_ROWS = 4000


def trace_rows(
    points_uv: Array, weights: Array, spacing_px: Array, most: int, inside: BoolArray
) -> tuple[IntArray, Array]:
    """Return the best traces through candidates.

    Parameters
    ----------
    points_uv : (n, 2)
        Candidates, pixels.
    weights : (n,)
        Their :func:`~fluoromap.segmenter.linking.evidence`.
    spacing_px : (electrodes - 1,)
        Spacings from the tip on, at the isocentre, not foreshortened.
    most : int
        At most so many traces are returned.
    inside : (rows, columns) bool
        The field. Up to half of the electrodes may lie outside it.

    Returns
    -------
    rows : (k, electrodes)
        Index of the candidate of each electrode from the tip on, -1 where one is missing; best first.
    places_uv : (k, electrodes, 2)
        The candidates' places; missing electrodes lie between their neighbours or straight on.
    """
    best = np.sort(np.argsort(-weights, kind="stable")[:_MOST_SEEDS])
    electrodes = len(spacing_px) + 1
    rows = np.empty((_MOST_ROWS, electrodes), np.int64)
    places, scores = np.empty((_MOST_ROWS, electrodes, 2)), np.empty(_MOST_ROWS)
    count = _trace(points_uv, weights, spacing_px, best, int(_MOST_MISSING * electrodes), inside, rows, places, scores)
    rows, first = np.unique(rows[:count], axis=0, return_index=True)
    order = np.argsort(-scores[first], kind="stable")[:most]
    rows, places = rows[order], places[first[order]]
    _interpolate(rows, spacing_px, places)
    return rows, places


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _trace(points, weights, spacing, seeds, most_missing, inside, rows, places, scores):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write all traces with few enough missing electrodes; return how many."""
    m = spacing.size + 1
    count = 0
    row = np.empty(m, np.int64)
    place = np.empty((m, 2))
    for i in seeds:
        for j in seeds:
            du, dv = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
            length = math.sqrt(du * du + dv * dv)
            if i == j or length < 1e-6:
                continue
            for a in range(m - 1):
                seen = length / spacing[a]
                if seen < SHORTEST or seen > LONGEST:
                    continue
                for k in range(m):
                    row[k] = -1
                row[a], row[a + 1] = i, j
                place[a, 0], place[a, 1] = points[i, 0], points[i, 1]
                place[a + 1, 0], place[a + 1, 1] = points[j, 0], points[j, 1]
                score = weights[i] + weights[j]
                missing = beyond = 0
                for way in range(2):
                    step = 1 if way == 0 else -1
                    at = a + 1 if way == 0 else a
                    direction_u, direction_v = step * du / length, step * dv / length
                    ratio = seen
                    before, bend = length, 0.0
                    gap = 0
                    while 0 <= at + step < m and missing <= most_missing:
                        space = spacing[at] if step > 0 else spacing[at - 1]
                        reach = space * ratio
                        turn = 0.5 * bend * (before + reach)
                        cosine, sine = math.cos(turn), math.sin(turn)
                        direction_u, direction_v = (
                            cosine * direction_u - sine * direction_v,
                            sine * direction_u + cosine * direction_v,
                        )
                        eu, ev = place[at, 0] + direction_u * reach, place[at, 1] + direction_v * reach
                        gate = _GATE * reach + _GATE_PX
                        found = -1
                        value = -1e9
                        for c in range(points.shape[0]):
                            au, av = points[c, 0] - eu, points[c, 1] - ev
                            square = au * au + av * av
                            if square > gate * gate:
                                continue
                            taken = False
                            for k in range(m):
                                if row[k] == c:
                                    taken = True
                            worth = weights[c] - 1.5 * square / (gate * gate)
                            if not taken and worth > value:
                                value = worth
                                found = c
                        at += step
                        before = reach
                        if found < 0:
                            place[at, 0], place[at, 1] = eu, ev
                            if (
                                eu < 0
                                or ev < 0
                                or eu >= inside.shape[1]
                                or ev >= inside.shape[0]
                                or not inside[int(ev), int(eu)]
                            ):
                                beyond += 1
                                continue
                            missing += 1
                            gap += 1
                            if gap > _MISSING_IN_A_ROW:
                                missing = m
                            continue
                        gap = 0
                        row[at] = found
                        place[at, 0], place[at, 1] = points[found, 0], points[found, 1]
                        score += value
                        mu, mv = place[at, 0] - place[at - step, 0], place[at, 1] - place[at - step, 1]
                        moved = max(math.sqrt(mu * mu + mv * mv), 1e-9)
                        ratio = min(max(0.5 * ratio + 0.5 * moved / space, SHORTEST), LONGEST)
                        mu, mv = mu / moved, mv / moved
                        ahead_u, ahead_v = (
                            cosine * direction_u + sine * direction_v,
                            cosine * direction_v - sine * direction_u,
                        )
                        bent = math.atan2(ahead_u * mv - ahead_v * mu, ahead_u * mu + ahead_v * mv)
                        bend = _KEPT_BEND * bent / max(0.5 * (before + moved), 1e-9)
                        direction_u, direction_v, before = mu, mv, moved
                if missing > most_missing or 2 * (missing + beyond) > m or count == rows.shape[0]:
                    continue
                for k in range(m):
                    rows[count, k] = row[k]
                    places[count, k, 0], places[count, k, 1] = place[k, 0], place[k, 1]
                scores[count] = score - _MISSING_PRICE * missing
                count += 1
    return count


def _interpolate(rows: IntArray, spacing_px: Array, places: Array) -> None:
    """Put missing electrodes between their neighbours, in place."""
    arc = np.concatenate([[0.0], np.cumsum(spacing_px)])
    for row, place in zip(rows, places, strict=True):
        known = np.flatnonzero(row >= 0)
        inner = np.flatnonzero((row < 0) & (np.arange(len(row)) > known[0]) & (np.arange(len(row)) < known[-1]))
        for axis in (0, 1):
            place[inner, axis] = np.interp(arc[inner], arc[known], place[known, axis])
