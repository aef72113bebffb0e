"""Sub-pixel places of the electrodes of a chain: the middle of each band, along and across the catheter."""

from __future__ import annotations

from collections.abc import Sequence
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
_FLOOR_PX = 0.08
_TIP_FLOOR_PX = 0.18
_GAIN = 2.25
_TIP_GAIN = 3.1
_CLEARER, _USUAL_CLEARNESS, _LEAST_SHARE = 0.65, 1.9, 0.42
_MOST_SHARE = 1.4
_MISMATCH_ALONG = 0.03
_MISMATCH_ACROSS = 0.06
_SPACING_SD = 0.10
_PROFILE_SAMPLES = 7.0
_WINDOW_MM = 2.0
_LEAST_MISFIT = 0.01
_COVERED_PX = 30.0
_HIDDEN_MM = 0.25
_STIFFNESS = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """points_uv : (n, 2) px. covariance_px2 : (n, 2, 2). misfits : (n,) share of each band's profile that its template does
    not explain."""

    points_uv: Array
    covariance_px2: Array
    misfits: Array

    @property
    def log_likelihood(self) -> float:
        """How well bands of these lengths fit the image, up to a constant common to all catheters, and both directions, tried
        on the same candidates."""
        return 0.5 * _PROFILE_SAMPLES * len(self.misfits) * self.clearness

    @property
    def clearness(self) -> float:
        """Mean of -ln(misfit) over the electrodes: 0 where nothing looks like one, above 1 where most of each profile does."""
        return -float(np.log(np.maximum(self.misfits, _LEAST_MISFIT)).mean())


def refine(image: Image, points_uv: Array, catheter: Catheter, px_per_mm: float, hidden: Sequence[int] = ()) -> Refined:
    """Move each electrode to where a band of its length and width fits best.

    Along the axis the profile is compared with a box of the electrode's foreshortened length (the tip's far end rounded),
    across it with the chord of a cylinder; zero-mean correlation, parabola through the best shift; two rounds. Points far
    off the catalogue's spacing are then drawn towards it by their own uncertainty.

    Parameters
    ----------
    image : (rows, columns) float32
        Log image.
    points_uv : (n, 2)
        First guess from the tip on, pixels.
    hidden : sequence of int
        Electrodes whose image is another catheter's: they are put where the curve through the others has them, and fit as
        well as the others do on average.
    """
    covered = np.zeros(len(points_uv), dtype=np.bool_)
    covered[list(hidden)] = True
    points, covariance, misfits = _refine(
        image,
        np.ascontiguousarray(points_uv, dtype=np.float64),
        covered,
        catheter.arc_lengths_mm,
        catheter.tip_mm,
        catheter.ring_mm,
        0.5 * _diameter_mm(catheter),
        px_per_mm,
    )
    if covered.any() and np.count_nonzero(~covered) >= 2:
        points[covered] = on_curve(points, covered, catheter.arc_lengths_mm)
        covariance[covered] = (_HIDDEN_MM * px_per_mm) ** 2 * np.eye(2)
        misfits[covered] = np.exp(np.log(misfits[~covered]).mean())
    return Refined(points, covariance, misfits)


def on_curve(points: Array, covered: BoolArray, arc_mm: Array) -> Array:
    """Places of the covered electrodes on a parabola in arc length through the others, its curvature kept low."""
    middle = arc_mm.mean()
    design = np.stack([np.ones(len(arc_mm)), arc_mm - middle, (arc_mm - middle) ** 2], axis=1)
    known = np.concatenate([design[~covered], [[0.0, 0.0, _STIFFNESS]]])
    answer = np.linalg.lstsq(known, np.concatenate([points[~covered], np.zeros((1, 2))]), rcond=None)[0]
    predicted: Array = design[covered] @ answer
    return predicted


def _diameter_mm(catheter: Catheter) -> float:
    """Catalogues give no diameter: 7F for the longer tips of ablation catheters, 6F else."""
    return 2.33 if catheter.tip_mm >= 3.0 else 2.0


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _refine(image, first, covered, arc_mm, tip_mm, ring_mm, radius_mm, px_per_mm):  # type: ignore[no-untyped-def]  # pragma: no cover
    n = first.shape[0]
    points = first.copy()
    radius = radius_mm * px_per_mm
    total = arc_mm[n - 1] * px_per_mm
    along = np.empty(n)
    across = np.empty(n)
    axes = np.empty((n, 2))
    fit = np.empty(5)
    misfits = np.empty(n)
    for attempt in range(2):
        seen = 0.0
        for k in range(n - 1):
            seen += np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
        shortening = min(max(seen / total, SHORTEST), LONGEST)
        window = _WINDOW_MM * px_per_mm * shortening + 2.0
        _find_axes(points, axes)
        for k in range(n):
            half = max(0.5 * (tip_mm if k == 0 else ring_mm) * px_per_mm * shortening, 0.75)
            reach = _LAST_REACH_PX if attempt else _TIP_REACH_PX if k == 0 else _REACH_PX
            dome = radius if k == 0 else 0.0
            _fit_band(image, points[k, 0], points[k, 1], axes[k, 0], axes[k, 1], half, radius, reach, dome, window, fit)
            points[k] = fit[:2]
            along[k] = fit[2]
            across[k] = fit[3]
            misfits[k] = fit[4]
    _find_axes(points, axes)
    # Where bands fit well, what they leave unexplained is the template's own simplicity rather than noise.
    clearness = -np.log(np.maximum(misfits, _LEAST_MISFIT)).mean()
    trust = min(max(1.0 - _CLEARER * (clearness - _USUAL_CLEARNESS), _LEAST_SHARE), _MOST_SHARE)
    for k in range(n):
        gain = trust * (_TIP_GAIN if k == 0 else _GAIN)
        along[k] = np.hypot(min(gain * along[k], _APART_PX), _TIP_FLOOR_PX if k == 0 else _FLOOR_PX)
        across[k] = np.hypot(min(gain * across[k], _APART_PX), _FLOOR_PX)
        if covered[k]:
            along[k] = _COVERED_PX
    if n >= 3:
        _draw_to_spacing(points, axes, along, arc_mm, _SPACING_SD * px_per_mm * arc_mm[n - 1] / (n - 1) / 2.0)
    covariance = np.empty((n, 2, 2))
    for k in range(n):
        cu, cv, a, b = axes[k, 0], axes[k, 1], along[k] ** 2, across[k] ** 2
        covariance[k, 0, 0] = a * cu * cu + b * cv * cv
        covariance[k, 1, 1] = a * cv * cv + b * cu * cu
        covariance[k, 0, 1] = covariance[k, 1, 0] = (a - b) * cu * cv
    return points, covariance, misfits


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _find_axes(points, axes):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Unit vectors along the catheter at each electrode, from the tip on."""
    last = points.shape[0] - 1
    for k in range(last + 1):
        after, before = min(k + 1, last), max(k - 1, 0)
        du, dv = points[after, 0] - points[before, 0], points[after, 1] - points[before, 1]
        length = max(np.hypot(du, dv), 1e-9)
        axes[k, 0], axes[k, 1] = du / length, dv / length


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _draw_to_spacing(points, axes, along, arc_mm, model_sd):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Combine measured arc lengths with the catalogue's spacing under one free foreshortening and offset, in place."""
    n = points.shape[0]
    arc = np.zeros(n)
    for k in range(1, n):
        arc[k] = arc[k - 1] + np.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
    weight = 1.0 / along**2
    mean_x = (weight * arc_mm).sum() / weight.sum()
    mean_y = (weight * arc).sum() / weight.sum()
    slope = (weight * (arc_mm - mean_x) * (arc - mean_y)).sum() / (weight * (arc_mm - mean_x) ** 2).sum()
    for k in range(n):
        share = along[k] ** 2 / (along[k] ** 2 + model_sd**2)
        move = share * (mean_y + slope * (arc_mm[k] - mean_x) - arc[k])
        points[k, 0] += move * axes[k, 0]
        points[k, 1] += move * axes[k, 1]
        along[k] *= np.sqrt(1.0 - 0.5 * share)


@njit(inline="always")
def _sample(x, u, v):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = x.shape
    u = min(max(u, 0.0), columns - 1.001)
    v = min(max(v, 0.0), rows - 1.001)
    i, j = int(u), int(v)
    f, g = np.float32(u - i), np.float32(v - j)
    one = np.float32(1)
    return (x[j, i] * (one - f) + x[j, i + 1] * f) * (one - g) + (x[j + 1, i] * (one - f) + x[j + 1, i + 1] * f) * g


@njit(inline="always")
def _band(u, half, dome):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Profile of an electrode along its axis, 0 to 1; -half is the far end, a dome of that radius at a tip."""
    near = min(max(0.5 + (half - u) / _SOFT_PX, 0.0), 1.0)
    depth = u + half
    if dome > 0:
        rim = 1.0 - min(max(depth / dome, 0.0), 1.0)
        return near * np.sqrt(1.0 - rim * rim)
    return near * min(max(0.5 + depth / _SOFT_PX, 0.0), 1.0)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _best_shift(profile, template, shifts, mismatch):  # type: ignore[no-untyped-def]  # pragma: no cover
    """(shift in samples, its standard deviation, unexplained share of the profile's variance) of the template that fits the
    dark parts of the profile best; the profile is ``shifts - 1`` samples longer. ``mismatch`` is the share that the template
    leaves unexplained without any noise."""
    m = template.size
    mean_t = template.mean()
    vt = 0.0
    edges = 0.0
    for i in range(m):
        template[i] -= mean_t
        vt += template[i] ** 2
        if i > 0:
            edges += (template[i] - template[i - 1]) ** 2
    vt = max(vt, 1e-9)
    scores = np.empty(shifts)
    chosen = 0
    for k in range(shifts):
        c = 0.0
        for i in range(m):
            c -= template[i] * profile[k + i]
        scores[k] = c
        if c > scores[chosen]:
            chosen = k
    sp = spp = 0.0
    for i in range(m):
        p = profile[chosen + i]
        sp += p
        spp += p * p
    vp = max(spp - sp * sp / m, 1e-12)
    c = scores[chosen]
    amplitude = max(c / vt, 1e-9)
    rest = max(1.0 - max(c, 0.0) ** 2 / (vt * vp), 0.0)
    # Cramer-Rao bound of a shift in white noise; samples half a pixel apart share theirs.
    noise = max(rest - mismatch, 0.25 * rest)
    sd = np.sqrt(2.0 * noise * vp / m / max(edges, 1e-9)) / amplitude
    fine = 0.0
    if 0 < chosen < shifts - 1:
        curvature = scores[chosen - 1] - 2 * scores[chosen] + scores[chosen + 1]
        if curvature < 0:
            fine = 0.5 * (scores[chosen - 1] - scores[chosen + 1]) / curvature
    return chosen - (shifts - 1) // 2 + fine, sd, rest


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _fit_band(x, u, v, au, av, half, radius, reach, dome, window, fit):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes (u, v, SD along, SD across, misfit) of the best place near (u, v) for a band along (au, av) to ``fit``."""
    side = int(window / _STEP_PX)
    shift = int(reach / _STEP_PX)
    template = np.empty(2 * side + 1)
    for i in range(template.size):
        template[i] = _band((i - side) * _STEP_PX, half, dome)
    lines = max(1, int(1.5 * radius))
    profile = np.zeros(2 * (side + shift) + 1)
    for k in range(lines):
        w = 1.5 * radius * ((k + 0.5) / lines - 0.5)
        for i in range(profile.size):
            s = (i - side - shift) * _STEP_PX
            profile[i] += _sample(x, u + s * au - w * av, v + s * av + w * au)
    profile /= lines
    moved, sd_along, rest = _best_shift(profile, template, 2 * shift + 1, _MISMATCH_ALONG)
    u += moved * _STEP_PX * au
    v += moved * _STEP_PX * av
    side = int((radius + 4.0) / _STEP_PX)
    shift = int(min(reach, 3.5) / _STEP_PX)
    template = np.empty(2 * side + 1)
    for i in range(template.size):
        template[i] = np.sqrt(max(1.0 - ((i - side) * _STEP_PX / radius) ** 2, 0.0))
    lines = max(1, int(2 * half))
    profile = np.zeros(2 * (side + shift) + 1)
    for k in range(lines):
        s = 2 * half * ((k + 0.5) / lines - 0.5)
        for i in range(profile.size):
            w = (i - side - shift) * _STEP_PX
            profile[i] += _sample(x, u + s * au - w * av, v + s * av + w * au)
    profile /= lines
    moved, sd_across, _ = _best_shift(profile, template, 2 * shift + 1, _MISMATCH_ACROSS)
    fit[0] = u - moved * _STEP_PX * av
    fit[1] = v + moved * _STEP_PX * au
    fit[2] = sd_along * _STEP_PX
    fit[3] = sd_across * _STEP_PX
    fit[4] = rest
