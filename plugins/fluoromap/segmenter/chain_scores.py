"""Score of a path through candidates as a catheter: spacings, bends and shaft.

Every function works on many chains at once; ``places`` are (n, electrodes, 2) pixels from the tip on.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numba import njit

from fluoromap.contracts import Array, IntArray
from fluoromap.segmenter.chain_search import MANY_ELECTRODES, TURNING_ELECTRODES
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.row_shape import row_fit

_SPACING_SD, _LOOP_SPACING_SD = 0.06, 0.12
"""Of the ratio between visible and true spacing. Loops are made in several sizes, and some can be tightened."""
_TREND_SD_PER_MM, _MOST_TREND_SD = 0.045, 0.9
_DRIFT_SD_PER_MM, _LEAST_SLOPE = 0.03, 0.15
_LOOP_DRIFT = 0.8
"""How fast the foreshortening of a loop changes, as a part of its curvature."""
_BEND_SD, _USUAL_GAP_MM = 0.36, 4.7
"""Standard deviation of a bend between two gaps, radians; in proportion more where both are wider than usual."""
_S_BEND, _S_BEND_WEIGHT = 0.12, 1.5
_FORESHORTENED, _FORESHORTENED_WEIGHT = 0.75, 2.0
_LOOP_SCALE, _LOOP_SIZE_SD = 1.1, 0.2
_LOOP_TURN_SD, _MOST_UNLIKE_LOOP = 0.9, 3.0
_LEAST_SEEN = 0.1
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
    nearly always, or it turns through the viewing direction, see :mod:`~fluoromap.segmenter.row_shape`.

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
        shafts = shaft_evidence(places[rows], widest, tip_mm, px_per_mm, smooth, reduction, clear, side)
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
        if left < -_S_BEND and right > _S_BEND:
            squares *= _S_BEND_WEIGHT * _S_BEND_WEIGHT
        score -= 0.5 * squares / (_BEND_SD * _BEND_SD)
        score -= _FORESHORTENED_WEIGHT * max(0.0, _FORESHORTENED - seen / total)
        out[row] = score if 2 * unsure <= m else -np.inf


def bend_freedom(spacing_mm: Array) -> Array:
    """Return how much more than usual each bend may be, (gaps - 1,)."""
    return np.maximum(1.0, np.minimum(spacing_mm[:-1], spacing_mm[1:]) / _USUAL_GAP_MM)


def loop_fit(places: Array, spacing_px: Array, curvature_per_mm: float, px_per_mm: float) -> Array:
    """Return how much more likely a loop is than a straight catheter, (n,).

    The image of a circle is an ellipse. A small turn in the image, times the square of the foreshortening there, is the turn on the
    circle times the ratio of the ellipse's axes. That ratio is free where the foreshortening allows it. The size of the circle
    differs from the described one by a fifth. The whole turn is that of the circle from every side; where it is not, an
    unlikeness that is limited counts: seen edge on, the turns have no certain sign. All are 0 without a curvature.
    """
    if not curvature_per_mm:
        return np.zeros(len(places))
    gaps = np.diff(places, axis=1)
    ratios = np.linalg.norm(gaps, axis=2) / spacing_px
    seen = np.minimum(ratios, 1.0)
    u, v = gaps[..., 0], gaps[..., 1]
    turns = np.arctan2(u[:, :-1] * v[:, 1:] - v[:, :-1] * u[:, 1:], (gaps[:, :-1] * gaps[:, 1:]).sum(axis=2))
    freedom = bend_freedom(spacing_px / px_per_mm) ** 2
    shares = np.maximum(seen[:, :-1] * seen[:, 1:], _LEAST_SEEN)
    on_circle = curvature_per_mm / px_per_mm * 0.5 * (spacing_px[:-1] + spacing_px[1:])
    squares, products = (turns * turns * shares / freedom).sum(axis=1), turns @ (on_circle / freedom)
    circle = (on_circle**2 / shares / freedom).sum(axis=1)
    # The mean square of the foreshortening of an ellipse; a loop may be larger than described.
    least = np.sqrt(np.clip(2.0 * (seen * seen).mean(axis=1) / _LOOP_SCALE**2 - 1.0, 0.0, 1.0))
    axes = products / circle
    axes = np.where(axes < 0, -1.0, 1.0) * np.clip(np.abs(axes), least, 1.0)
    left = squares - 2.0 * axes * products + axes * axes * circle
    is_s = (turns.min(axis=1) < -_S_BEND) & (turns.max(axis=1) > _S_BEND)
    straight = squares * np.where(is_s, _S_BEND_WEIGHT * _S_BEND_WEIGHT, 1.0)
    unlike = (np.abs(turns.sum(axis=1)) - on_circle.sum()) / _LOOP_TURN_SD
    # The mean square of the foreshortening on an ellipse is that of its axes.
    log_size = 0.5 * np.log(2.0 * (ratios * ratios).mean(axis=1) / (1.0 + axes * axes))
    better: Array = 0.5 * (straight - left) / (_BEND_SD * _BEND_SD)
    better -= np.minimum(0.5 * unlike * unlike, _MOST_UNLIKE_LOOP)
    better -= 0.5 * (log_size / _LOOP_SIZE_SD) ** 2
    return better


def spacing_fit(
    places: Array, spacing_px: Array, variance_px2: Array, curvature_per_mm: float, px_per_mm: float
) -> Array:
    """Return the log-likelihood of these spacings at the places, up to a constant, (n,).

    One foreshortening is free; it may change along the catheter as far as catheters bend in depth. ``variance_px2`` (n,
    electrodes) is the variance of each place. The variance of each ratio between visible and true spacing contains
    those of its two ends and of the bend. A loop turns in depth as fast as its curvature allows.
    """
    out = np.empty(len(places))
    if len(spacing_px) + 1 >= MANY_ELECTRODES:
        drift = max(_DRIFT_SD_PER_MM, _LOOP_DRIFT * curvature_per_mm)
        spacing_sd = _LOOP_SPACING_SD if curvature_per_mm else _SPACING_SD
        _fit_many_spacings(places, spacing_px, variance_px2, spacing_sd, drift / px_per_mm, out)
    else:
        _fit_spacings(places, spacing_px, variance_px2, px_per_mm, out)
    return out


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _fit_many_spacings(places, spacing_px, variance_px2, spacing_sd, drift_per_px, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the log-likelihoods for a long catheter, whose foreshortening may rise and fall again.

    The ratio of visible to true spacing drifts from gap to gap as far as a bend in depth allows; a Kalman filter follows it.
    """
    for row in range(places.shape[0]):
        ratio = spread = rest = before = 0.0
        for k in range(spacing_px.size):
            du, dv = places[row, k + 1, 0] - places[row, k, 0], places[row, k + 1, 1] - places[row, k, 1]
            spacing = spacing_px[k]
            seen = math.sqrt(du * du + dv * dv) / spacing
            noise = spacing_sd * spacing_sd + (variance_px2[row, k] + variance_px2[row, k + 1]) / (spacing * spacing)
            if k == 0:
                ratio, spread = seen, noise
            else:
                slope = drift_per_px * 0.5 * (before + spacing)
                spread += slope * slope * max(1.0 - ratio * ratio, _LEAST_SLOPE)
                total = spread + noise
                away = seen - ratio
                rest += away * away / total + math.log(total / noise)
                gain = spread / total
                ratio += gain * away
                spread *= 1.0 - gain
            before = spacing
        out[row] = -0.5 * rest


@kernel("f8[:,:,::1], f8[::1], f8[:,::1], f8, f8[::1]")
def _fit_spacings(places, spacing_px, variance_px2, px_per_mm, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    n = spacing_px.size
    reach = -0.5 * (spacing_px[0] + spacing_px[n - 1])
    for k in range(n):
        reach += spacing_px[k]
    for row in range(places.shape[0]):
        weights = total = squares = along = place_squares = products = arc = 0.0
        for k in range(n):
            du, dv = places[row, k + 1, 0] - places[row, k, 0], places[row, k + 1, 1] - places[row, k, 1]
            spacing = spacing_px[k]
            seen = math.sqrt(du * du + dv * dv) / spacing
            weight = 1.0 / (
                _SPACING_SD * _SPACING_SD + (variance_px2[row, k] + variance_px2[row, k + 1]) / (spacing * spacing)
            )
            place = (arc + 0.5 * spacing) / max(reach, 1e-9)
            arc += spacing
            weights += weight
            total += weight * seen
            squares += weight * seen * seen
            along += weight * place
            place_squares += weight * place * place
            products += weight * place * seen
        mean = total / weights
        rest = squares - total * mean
        # A bend in depth changes the ratio along the catheter by the sine of its slope to the image.
        slope_sd = min(_TREND_SD_PER_MM * reach / px_per_mm, _MOST_TREND_SD)
        variance = slope_sd * slope_sd * max(1.0 - mean * mean, 0.0)
        spread = place_squares - along * along / weights
        if variance > 0 and n > 1:
            trend = products - along * mean
            rest += math.log(1.0 + variance * spread) - trend * trend / (spread + 1.0 / variance)
        out[row] = -0.5 * rest


def shaft_evidence(
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
