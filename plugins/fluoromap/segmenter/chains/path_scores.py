"""Score of a path through candidates as a catheter: spacings, bends and shaft.

Every function works on many chains at once; ``places`` are (n, electrodes, 2) pixels from the tip on.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from fluoromap.contracts import Array, IntArray
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.shape.bends import BEND_SD, S_BEND, S_BEND_WEIGHT, bend_freedom
from fluoromap.segmenter.shape.limits import TURNING_ELECTRODES
from fluoromap.segmenter.shape.loops import loop_fit
from fluoromap.segmenter.shape.row_shape import row_fit
from fluoromap.segmenter.shape.spacings import spacing_fit

_FORESHORTENED, _FORESHORTENED_WEIGHT = 0.75, 2.0
_ROW_WEIGHT, _TURNING_PRICE = 2.0, 4.0
_UNLIKE_WEIGHT = 0.6
_BEHIND_MM = 2.4, 5.9
_BEFORE_MM = 2.1, 3.5


def score_paths(
    chosen: IntArray, points: Array, weights: Array, variance_px2: Array, sure: int, lost: float, spacing_px: Array, tip_mm: float,
    curvature_per_mm: float, px_per_mm: float, smooth: Image, reduction: int, clear: float, side: float, shaft_weight: float,
    least: float,
) -> Array:  # fmt: skip
    """Return the score of each path, (n,).

    A row of eight or more is scored in two ways, of which the better one counts: its foreshortening changes slowly, as it does
    nearly always, or it turns through the viewing direction, see :mod:`~fluoromap.segmenter.shape.row_shape`.

    The score is -inf for a path that cannot reach ``least`` even with a perfect shaft. The shafts of these paths are not
    measured.
    """
    places, variances = np.empty((*chosen.shape, 2)), np.empty(chosen.shape)
    out = np.empty(len(chosen))
    freedom = bend_freedom(spacing_px / px_per_mm)
    _score_shapes(chosen, points, weights, variance_px2, sure, lost, spacing_px, freedom, places, variances, out)
    out += spacing_fit(places, spacing_px, variances, curvature_per_mm, px_per_mm)
    if len(spacing_px) + 1 >= TURNING_ELECTRODES and not curvature_per_mm:
        turning, freedom = np.empty(len(chosen)), np.full(len(freedom), np.inf)
        _score_shapes(
            chosen, points, weights, variance_px2, sure, lost, spacing_px, freedom, places, variances, turning
        )
        turning += _ROW_WEIGHT * row_fit(places, tuple((spacing_px / px_per_mm).tolist()), variances, px_per_mm)
        out = np.maximum(out, turning - _TURNING_PRICE)
    out += loop_fit(places, spacing_px, curvature_per_mm, px_per_mm)
    hopeful = out + 3.0 * shaft_weight >= least
    out[~hopeful] = -np.inf
    rows = np.flatnonzero(hopeful)
    if rows.size:
        widest = int(np.argmax(spacing_px))
        shafts = shafts_of_paths(places[rows], widest, tip_mm, px_per_mm, smooth, reduction, clear, side)
        out[rows] += shaft_weight * shafts
        out[out < least] = -np.inf
    return out


@kernel("i8[:,::1], f8[:,::1], f8[::1], f8[::1], i8, f8, f8[::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[::1]")
def _score_shapes(  # type: ignore[no-untyped-def]  # pragma: no cover
    chosen, points, weights, variance_px2, sure, lost, spacing_px, freedom, places, variances, out
):  # fmt: skip
    """Write places, variances and score of each path.

    The score excludes spacings and shaft.
    """
    count, m = chosen.shape
    total = 0.0
    for k in range(m - 1):
        total += spacing_px[k]
    for row in range(count):
        unsure = 0
        score = low = high = 0.0
        for k in range(m):
            candidate = chosen[row, k]
            places[row, k, 0] = points[candidate, 0]
            places[row, k, 1] = points[candidate, 1]
            variances[row, k] = variance_px2[candidate]
            weight = weights[candidate]
            score += weight
            if candidate >= sure:
                unsure += 1
            if k == 1:
                low = high = weight
            elif k > 1:
                low, high = min(low, weight), max(high, weight)
        score -= lost * unsure + _UNLIKE_WEIGHT * (high - low)
        seen = squares = left = right = before_u = before_v = 0.0
        shortened = 1.0
        for k in range(m - 1):
            du, dv = places[row, k + 1, 0] - places[row, k, 0], places[row, k + 1, 1] - places[row, k, 1]
            length = math.sqrt(du * du + dv * dv)
            seen += length
            before, shortened = shortened, min(length / spacing_px[k], 1.0)
            if k > 0:
                turn = math.atan2(before_u * dv - before_v * du, before_u * du + before_v * dv)
                squares += turn * turn * before * shortened / (freedom[k - 1] * freedom[k - 1])
                left, right = min(left, turn), max(right, turn)
            before_u, before_v = du, dv
        if left < -S_BEND and right > S_BEND:
            squares *= S_BEND_WEIGHT * S_BEND_WEIGHT
        score -= 0.5 * squares / (BEND_SD * BEND_SD)
        score -= _FORESHORTENED_WEIGHT * max(0.0, _FORESHORTENED - seen / total)
        out[row] = score if 2 * unsure <= m else -np.inf


def shafts_of_paths(
    places: Array, widest: int, tip_mm: float, px_per_mm: float, smooth: Image, reduction: int, clear: float, side: float
) -> Array:  # fmt: skip
    """Return how clearly each path shows a shaft, -3 to 3, (n,).

    Dark pixels in the widest gap and behind the last electrode count for a shaft, dark pixels before the tip against it.

    Parameters
    ----------
    places : (n, electrodes, 2)
        Pixels from the tip on.
    widest : int
        Index of the widest gap.
    smooth : (rows, columns) float32
        The log image, ``reduction`` times smaller than the frame.
    clear : float
        Depth of a clearly visible shaft, log units.
    side : float
        Distance beside a shaft at which its surroundings are measured, pixels of the frame.
    """
    out = np.empty(len(places))
    pieces, reach = _shaft_pieces(places.shape[1], widest, tip_mm)
    _look_for_shafts(places, pieces, reach, px_per_mm, smooth, reduction, clear, side, out)
    return out


@functools.lru_cache(maxsize=64)
def _shaft_pieces(electrodes: int, widest: int, tip_mm: float) -> tuple[IntArray, Array]:
    """Return the pieces and their reach; see :func:`_look_for_shafts`."""
    before = 0.5 * tip_mm + _BEFORE_MM[0]
    pieces = np.array([[widest + 1, widest], [electrodes - 2, electrodes - 1], [1, 0]])
    return pieces, np.array([[-0.25, -0.75], _BEHIND_MM, [before, before + _BEFORE_MM[1]]])


@kernel("f8[:,:,::1], i8[:,::1], f8[:,::1], f8, f4[:,::1], i8, f8, f8, f8[::1]")
def _look_for_shafts(places, pieces, reach, px_per_mm, smooth, reduction, clear, side, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add, over three pieces, the mean of the darker side less the middle.

    Pixels outside the image do not count. A piece has the direction from its first to its second electrode. ``reach``
    is where it begins and ends beyond the second electrode: in millimetres behind and before the catheter, in parts of
    the gap between.
    """
    rows, columns = smooth.shape
    shift = 0.5 / reduction - 0.5
    aside = side / reduction
    for row in range(places.shape[0]):
        evidence = 0.0
        for piece in range(3):
            start, end = pieces[piece, 0], pieces[piece, 1]
            u, v = places[row, end, 0], places[row, end, 1]
            du, dv = u - places[row, start, 0], v - places[row, start, 1]
            if piece > 0:
                scale = px_per_mm / max(math.sqrt(du * du + dv * dv), 1e-9)
                du *= scale
                dv *= scale
            u0 = (u + reach[piece, 0] * du) / reduction + shift
            v0 = (v + reach[piece, 0] * dv) / reduction + shift
            du *= (reach[piece, 1] - reach[piece, 0]) / reduction
            dv *= (reach[piece, 1] - reach[piece, 0]) / reduction
            length = math.sqrt(du * du + dv * dv) + 1e-9
            across_u, across_v = -dv / length * aside, du / length * aside
            steps = max(3, int(length * reduction / 2))
            total = 0.0
            count = 0
            for i in range(steps):
                t = (i + 0.5) / steps
                cu, cv = u0 + t * du, v0 + t * dv
                if (
                    min(cu - abs(across_u), cv - abs(across_v)) >= 0
                    and cu + abs(across_u) <= columns - 1
                    and cv + abs(across_v) <= rows - 1
                ):
                    one = smooth[int(cv + across_v + 0.5), int(cu + across_u + 0.5)]
                    other = smooth[int(cv - across_v + 0.5), int(cu - across_u + 0.5)]
                    total += min(one, other) - smooth[int(cv + 0.5), int(cu + 0.5)]
                    count += 1
            mean = min(max(total / max(count, 1) / clear, -1.0), 1.0)
            evidence += mean if piece < 2 else -mean
        out[row] = evidence
