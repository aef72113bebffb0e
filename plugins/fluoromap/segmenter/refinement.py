"""Sub-pixel places of the electrodes of a chain: the middle of each band, along and across the catheter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.chain_search import LONGEST, SHORTEST
from fluoromap.segmenter.log_image import Image

_STEP_PX = 0.5
_REACH_PX = 3.5
_TIP_REACH_PX = 6.0
_LAST_REACH_PX = 2.0
_SOFT_PX = 2.0
_APART_PX = 6.0
_FLOOR_PX = 0.07
_TIP_FLOOR_PX = 0.10
_GAIN = 2.65
_TIP_GAIN, _LONG_TIP_GAIN = (3.1, 3.1), (3.9, 4.2)
_LONG_TIP_MM = 3.0
_STEEP, _STEEP_MM, _STEEP_SECOND = 0.80, 1.0, 0.7
_ACROSS, _ACROSS_POWER = 1.38, 0.85
_CLEARER, _USUAL_CLEARNESS, _LEAST_SHARE = 0.46, 1.9, 0.34
_MOST_SHARE = 1.4
_MISMATCH_ALONG = 0.03
_MISMATCH_ACROSS = 0.10
_LEAST_NOISE = 0.12
_SPACING_SD = 0.10
_PROFILE_SAMPLES = 7.0
_WINDOW_MM = 2.0
_LEAST_MISFIT = 0.01
_COVERED_PX = 30.0
_HIDDEN_MM = 0.25
_STIFFNESS = 6.0
_LOCAL, _LEAST_SHORTENING = 0.75, 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """points_uv : (n, electrodes, 2) px. covariance_px2 : (n, electrodes, 2, 2). misfits : (n, electrodes) share of each band's
    profile that its template does not explain."""

    points_uv: Array
    covariance_px2: Array
    misfits: Array

    @property
    def log_likelihood(self) -> Array:
        """How well bands of these lengths fit the image, up to a constant common to all catheters, and both directions, tried
        on the same candidates; (n,)."""
        likelihood: Array = 0.5 * _PROFILE_SAMPLES * self.misfits.shape[1] * self.clearness
        return likelihood

    @property
    def clearness(self) -> Array:
        """Mean of -ln(misfit) over the electrodes: 0 where nothing looks like one, above 1 where most of each profile does;
        (n,)."""
        mean: Array = -np.log(np.maximum(self.misfits, _LEAST_MISFIT)).mean(axis=1)
        return mean


def refine(
    image: Image,
    points_uv: Array,
    catheter: Catheter,
    px_per_mm: float,
    hidden: BoolArray,
    unseen: BoolArray,
) -> Refined:
    """Move each electrode of several chains to where a band of its length and width fits best.

    Along the axis the profile is compared with a box of the electrode's foreshortened length (the tip's far end rounded),
    across it with the chord of a cylinder; zero-mean correlation, parabola through the best shift; two rounds. Points far
    off the catalogue's spacing are then drawn towards it by their own uncertainty.

    Parameters
    ----------
    image : (rows, columns) float32
        Log image.
    points_uv : (n, electrodes, 2)
        First guess of each chain from the tip on, pixels.
    hidden : (n, electrodes)
        Electrodes whose image is another catheter's: they are put where the curve through the others has them, and fit as
        well as the others do on average.
    unseen : (n, electrodes)
        Electrodes without a blob of their own: they are looked for close by only.
    """
    points = np.array(points_uv, dtype=np.float64, order="C")
    arc_mm = catheter.arc_lengths_mm
    along, across, misfits, local, arc, axis_u, axis_v = np.empty((7, *points.shape[:2]))
    shortening = np.empty(len(points))
    radius = 0.5 * _diameter_mm(catheter) * px_per_mm
    half = np.full(len(arc_mm), 0.5 * catheter.ring_mm * px_per_mm)
    half[0] = 0.5 * catheter.tip_mm * px_per_mm
    reach = np.full(misfits.shape, _REACH_PX)
    reach[:, 0] = _TIP_REACH_PX
    reach[hidden | unseen] = _LAST_REACH_PX
    for _ in range(2):
        _measure(points, arc_mm, px_per_mm, arc, axis_u, axis_v, local, shortening)
        window = _WINDOW_MM * px_per_mm * shortening + 2.0
        _fit_bands(
            image, axis_u, axis_v, np.maximum(half * local, 0.75), radius, reach, window, points, along, across, misfits
        )
        reach[:] = _LAST_REACH_PX
    _measure(points, arc_mm, px_per_mm, arc, axis_u, axis_v, local, shortening)
    covariance = np.empty((*misfits.shape, 2, 2))
    gains = _LONG_TIP_GAIN if catheter.tip_mm >= _LONG_TIP_MM else _TIP_GAIN
    refined = Refined(points, covariance, misfits)
    _weigh(
        hidden, arc_mm, px_per_mm, gains[0], gains[1], refined.clearness, arc, axis_u, axis_v, along, across, points, covariance
    )  # fmt: skip
    for row in np.flatnonzero(hidden.any(axis=1)):
        covered = hidden[row]
        if np.count_nonzero(~covered) >= 2:
            points[row, covered] = on_curve(points[row], covered, arc_mm)
            covariance[row, covered] = (_HIDDEN_MM * px_per_mm) ** 2 * np.eye(2)
            misfits[row, covered] = np.exp(np.log(misfits[row, ~covered]).mean())
    return refined


def on_curve(points: Array, covered: BoolArray, arc_mm: Array) -> Array:
    """Places of the covered electrodes on a parabola in arc length through the others, its curvature kept low."""
    middle = arc_mm.mean()
    design = np.stack([np.ones(len(arc_mm)), arc_mm - middle, (arc_mm - middle) ** 2], axis=1)
    known = np.concatenate([design[~covered], [[0.0, 0.0, _STIFFNESS]]])
    answer = np.linalg.lstsq(known, np.concatenate([points[~covered], np.zeros((1, points.shape[1]))]), rcond=None)[0]
    predicted: Array = design[covered] @ answer
    return predicted


def _diameter_mm(catheter: Catheter) -> float:
    """Catalogues give no diameter: 7F for the longer tips of ablation catheters, 6F else."""
    return 2.33 if catheter.tip_mm >= _LONG_TIP_MM else 2.0


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _measure(points, arc_mm, px_per_mm, arc, axis_u, axis_v, local, shortening):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes the arc length seen up to each electrode, pixels, the unit vector along the catheter there, and the
    foreshortening there, from the gaps beside it and the whole catheter's, and of the whole catheter."""
    last = arc_mm.size - 1
    for row in range(points.shape[0]):
        arc[row, 0] = 0.0
        for k in range(last):
            du, dv = points[row, k + 1, 0] - points[row, k, 0], points[row, k + 1, 1] - points[row, k, 1]
            arc[row, k + 1] = arc[row, k] + math.sqrt(du * du + dv * dv)
        whole = min(max(arc[row, last] / (arc_mm[last] * px_per_mm), SHORTEST), LONGEST)
        shortening[row] = whole
        for k in range(last + 1):
            after, before = min(k + 1, last), max(k - 1, 0)
            ratio = (arc[row, after] - arc[row, before]) / (px_per_mm * (arc_mm[after] - arc_mm[before]))
            local[row, k] = min(max(_LOCAL * ratio + (1.0 - _LOCAL) * whole, _LEAST_SHORTENING), LONGEST)
            du = points[row, after, 0] - points[row, before, 0]
            dv = points[row, after, 1] - points[row, before, 1]
            length = max(math.sqrt(du * du + dv * dv), 1e-9)
            axis_u[row, k], axis_v[row, k] = du / length, dv / length


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _weigh(  # type: ignore[no-untyped-def]  # pragma: no cover
    covered, arc_mm, px_per_mm, tip_gain_along, tip_gain_across, clearness, arc, axis_u, axis_v, along, across, points, covariance
):  # fmt: skip
    """Standard deviations along and across from those of the fits; points drawn to the catalogue's spacing by them; covariances."""
    n = arc_mm.size
    for row in range(points.shape[0]):
        # Where bands fit well, what they leave unexplained is the template's own simplicity rather than noise.
        trust = min(max(1.0 - _CLEARER * (clearness[row] - _USUAL_CLEARNESS), _LEAST_SHARE), _MOST_SHARE)
        wider = trust * _ACROSS * min(trust, 1.0) ** _ACROSS_POWER
        weights = mean_x = mean_y = 0.0
        for k in range(n):
            least = _TIP_FLOOR_PX if k == 0 else _FLOOR_PX
            a = min(trust * (tip_gain_along if k == 0 else _GAIN) * along[row, k], _APART_PX)
            b = min(wider * (tip_gain_across if k == 0 else _GAIN) * across[row, k], _APART_PX)
            a = _COVERED_PX if covered[row, k] else math.sqrt(a * a + least * least)
            along[row, k] = a
            across[row, k] = math.sqrt(b * b + least * least)
            weights += 1.0 / (a * a)
            mean_x += arc_mm[k] / (a * a)
            mean_y += arc[row, k] / (a * a)
        if n >= 3:
            # Measured arc lengths and the catalogue's spacing, combined under one free foreshortening and offset.
            model_sd = 0.5 * _SPACING_SD * px_per_mm * arc_mm[n - 1] / (n - 1)
            mean_x /= weights
            mean_y /= weights
            products = squares = 0.0
            for k in range(n):
                weighted = (arc_mm[k] - mean_x) / (along[row, k] * along[row, k])
                products += weighted * (arc[row, k] - mean_y)
                squares += weighted * (arc_mm[k] - mean_x)
            for k in range(n):
                share = along[row, k] * along[row, k] / (along[row, k] * along[row, k] + model_sd * model_sd)
                move = share * (mean_y + products / squares * (arc_mm[k] - mean_x) - arc[row, k])
                points[row, k, 0] += move * axis_u[row, k]
                points[row, k, 1] += move * axis_v[row, k]
                along[row, k] *= math.sqrt(1.0 - 0.5 * share)
        # A steeply foreshortened tip covers the ring behind it, and its own axis is hard to tell.
        du, dv = points[row, 1, 0] - points[row, 0, 0], points[row, 1, 1] - points[row, 0, 1]
        lacking = max(_STEEP - math.sqrt(du * du + dv * dv) / (px_per_mm * (arc_mm[1] - arc_mm[0])), 0.0)
        steep = _STEEP_MM * px_per_mm * lacking * lacking
        for k in range(n):
            more = steep if k == 0 else _STEEP_SECOND * steep if k == 1 else 0.0
            cu, cv = axis_u[row, k], axis_v[row, k]
            a = along[row, k] * along[row, k] + more * more
            b = across[row, k] * across[row, k] + more * more
            covariance[row, k, 0, 0] = a * cu * cu + b * cv * cv
            covariance[row, k, 1, 1] = a * cv * cv + b * cu * cu
            covariance[row, k, 0, 1] = (a - b) * cu * cv
            covariance[row, k, 1, 0] = covariance[row, k, 0, 1]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _fit_bands(  # type: ignore[no-untyped-def]  # pragma: no cover
    x, axis_u, axis_v, half, radius, reach, window, points, along, across, misfits
):  # fmt: skip
    """Moves points to the best places near by for bands along these axes; writes the standard deviations of that along and
    across, and the share of the profile's variance along that stays unexplained.

    First along, then across the axis a template is moved over the profile; a tip's far end is a dome of its radius.
    """
    rows, columns = x.shape
    one = np.float32(1)
    for row in range(points.shape[0]):
        for k in range(points.shape[1]):
            for way in range(2):
                du, dv, span, wide, slack, mismatch = (
                    axis_u[row, k], axis_v[row, k], window[row], 1.5 * radius, reach[row, k], _MISMATCH_ALONG
                )  # fmt: skip
                if way == 1:
                    du, dv, span, wide, slack, mismatch = (
                        -axis_v[row, k], axis_u[row, k], radius + 4.0, 2.0 * half[row, k], min(reach[row, k], 3.5), _MISMATCH_ACROSS
                    )  # fmt: skip
                side, shift, lines = int(span / _STEP_PX), int(slack / _STEP_PX), max(1, int(wide))
                m = 2 * side + 1
                template = np.empty(m)
                mean = 0.0
                for i in range(m):
                    s = (i - side) * _STEP_PX
                    if way == 1:
                        template[i] = math.sqrt(max(1.0 - s * s / (radius * radius), 0.0))
                    else:
                        # From 0 to 1 and back; -half is the far end.
                        template[i] = min(max(0.5 + (half[row, k] - s) / _SOFT_PX, 0.0), 1.0)
                        if k == 0:
                            rim = 1.0 - min(max((s + half[row, k]) / radius, 0.0), 1.0)
                            template[i] *= math.sqrt(1.0 - rim * rim)
                        else:
                            template[i] *= min(max(0.5 + (s + half[row, k]) / _SOFT_PX, 0.0), 1.0)
                    mean += template[i]
                mean /= m
                strength = edges = before = 0.0
                for i in range(m):
                    template[i] -= mean
                    strength += template[i] * template[i]
                    step = template[i] - before if i > 0 else 0.0
                    edges += step * step
                    before = template[i]
                strength = max(strength, 1e-9)
                profile = np.empty(m + 2 * shift)
                for i in range(profile.size):
                    s = (i - side - shift) * _STEP_PX
                    total = 0.0
                    for line in range(lines):
                        w = wide * ((line + 0.5) / lines - 0.5)
                        u = min(max(points[row, k, 0] + s * du - w * dv, 0.0), columns - 1.001)
                        v = min(max(points[row, k, 1] + s * dv + w * du, 0.0), rows - 1.001)
                        left, top = int(u), int(v)
                        f, g = np.float32(u - left), np.float32(v - top)
                        upper = x[top, left] * (one - f) + x[top, left + 1] * f
                        lower = x[top + 1, left] * (one - f) + x[top + 1, left + 1] * f
                        total += upper * (one - g) + lower * g
                    profile[i] = total / lines
                scores = np.empty(2 * shift + 1)
                chosen = 0
                for place in range(scores.size):
                    score = 0.0
                    for i in range(m):
                        score -= template[i] * profile[place + i]
                    scores[place] = score
                    if score > scores[chosen]:
                        chosen = place
                total = squares = 0.0
                for i in range(m):
                    total += profile[chosen + i]
                    squares += profile[chosen + i] * profile[chosen + i]
                variance = max(squares - total * total / m, 1e-12)
                best = scores[chosen]
                rest = max(1.0 - max(best, 0.0) ** 2 / (strength * variance), 0.0)
                # Cramer-Rao bound of a shift in white noise; samples half a pixel apart share theirs. The mismatch is the share
                # that the template leaves unexplained without any noise.
                noise = max(rest - mismatch, _LEAST_NOISE * rest)
                sd = math.sqrt(2.0 * noise * variance / m / max(edges, 1e-9)) / max(best / strength, 1e-9)
                moved = float(chosen - shift)
                if 0 < chosen < 2 * shift:
                    curvature = scores[chosen - 1] - 2 * best + scores[chosen + 1]
                    if curvature < 0:
                        moved += 0.5 * (scores[chosen - 1] - scores[chosen + 1]) / curvature
                points[row, k, 0] += moved * _STEP_PX * du
                points[row, k, 1] += moved * _STEP_PX * dv
                if way == 0:
                    along[row, k], misfits[row, k] = sd * _STEP_PX, rest
                else:
                    across[row, k] = sd * _STEP_PX
