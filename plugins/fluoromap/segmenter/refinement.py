"""Sub-pixel places of the electrodes of a chain: the middle of each band, along and across the catheter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array
from fluoromap.segmenter.linking import LONGEST, SHORTEST
from fluoromap.segmenter.log_image import Image

_STEP_PX = 0.5
_REACH_PX = 3.5
_TIP_REACH_PX = 6.0
_LAST_REACH_PX = 2.0
_SOFT_PX = 2.0
_APART_PX = 6.0
_FLOOR_PX = 0.2
_TIP_FLOOR_PX = 0.45
_SPACING_SD = 0.10
_PROFILE_SAMPLES = 7.0
_WINDOW_MM = 2.0
_LEAST_MISFIT = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """points_uv : (n, 2) px. covariance_px2 : (n, 2, 2). log_likelihood : how well bands of these lengths fit the image, up
    to a constant common to all catheters, and both directions, tried on the same candidates."""

    points_uv: Array
    covariance_px2: Array
    log_likelihood: float


def refine(image: Image, points_uv: Array, catheter: Catheter, px_per_mm: float) -> Refined:
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
    """
    radius = 0.5 * _diameter_mm(catheter) * px_per_mm
    points = np.array(points_uv, dtype=np.float64)
    total = sum(catheter.spacing_mm) * px_per_mm
    deviations = np.zeros((len(points), 2))
    misfits = np.ones(len(points))
    for attempt in range(2):
        seen = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()) / total
        shortening = min(max(seen, SHORTEST), LONGEST)
        axes = _axes(points)
        moved = points.copy()
        for index in range(len(points)):
            tip = index == 0
            length = (catheter.tip_mm if tip else catheter.ring_mm) * px_per_mm
            half = max(0.5 * length * shortening, 0.75)
            reach = _LAST_REACH_PX if attempt else _TIP_REACH_PX if tip else _REACH_PX
            window = _WINDOW_MM * px_per_mm * shortening + 2.0
            place = _fit(image, points[index], axes[index], half, radius, reach, radius if tip else 0.0, window)
            moved[index] = place[:2]
            deviations[index] = place[2:4]
            misfits[index] = place[4]
        points = moved
    axes = _axes(points)
    floors = np.array([_TIP_FLOOR_PX] + [_FLOOR_PX] * (len(points) - 1))
    along = np.hypot(np.minimum(deviations[:, 0], _APART_PX), floors)
    across = np.hypot(np.minimum(deviations[:, 1], _APART_PX), _FLOOR_PX)
    points, along = _towards_spacing(points, axes, along, catheter, px_per_mm)
    normals = np.stack([-axes[:, 1], axes[:, 0]], axis=1)
    covariance = (along**2)[:, None, None] * np.einsum("ni,nj->nij", axes, axes)
    covariance += (across**2)[:, None, None] * np.einsum("ni,nj->nij", normals, normals)
    likelihood = -0.5 * _PROFILE_SAMPLES * float(np.log(np.maximum(misfits, _LEAST_MISFIT)).sum())
    return Refined(points, covariance, likelihood)


def _diameter_mm(catheter: Catheter) -> float:
    """Catalogues give no diameter: 7F for the longer tips of ablation catheters, 6F else."""
    return 2.33 if catheter.tip_mm >= 3.0 else 2.0


def _axes(points: Array) -> Array:
    """Unit vectors along the catheter at each electrode, from the tip on, (n, 2)."""
    after = np.concatenate([points[1:], points[-1:]])
    before = np.concatenate([points[:1], points[:-1]])
    direction = after - before
    unit: Array = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    return unit


def _towards_spacing(
    points: Array, axes: Array, along: Array, catheter: Catheter, px_per_mm: float
) -> tuple[Array, Array]:
    """Combine measured arc lengths with the catalogue's spacing under one free foreshortening and offset."""
    if len(points) < 3:
        return points, along
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    design = np.stack([catheter.arc_lengths_mm, np.ones(len(points))], axis=1)
    weight = 1.0 / along
    fitted = design @ np.linalg.lstsq(design * weight[:, None], arc * weight, rcond=None)[0]
    model_sd = _SPACING_SD * px_per_mm * float(np.mean(catheter.spacing_mm)) / 2.0
    share = along**2 / (along**2 + model_sd**2)
    moved = points + (share * (fitted - arc))[:, None] * axes
    return moved, along * np.sqrt(1.0 - share * 0.5)


def _fit(
    image: Image, point: Array, axis: Array, half: float, radius: float, reach: float, dome: float, window: float
) -> tuple[float, float, float, float, float]:
    u, v, sd_along, sd_across, misfit = _fit_band(
        image, point[0], point[1], axis[0], axis[1], half, radius, reach, dome, window, _STEP_PX, _SOFT_PX
    )
    return float(u), float(v), float(sd_along), float(sd_across), float(misfit)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _sample(x, u, v):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = x.shape
    u = min(max(u, 0.0), columns - 1.001)
    v = min(max(v, 0.0), rows - 1.001)
    i, j = int(u), int(v)
    f, g = u - i, v - j
    return (x[j, i] * (1 - f) + x[j, i + 1] * f) * (1 - g) + (x[j + 1, i] * (1 - f) + x[j + 1, i + 1] * f) * g


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _band(u, half, dome, soft):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Profile of an electrode along its axis, 0 to 1; -half is the far end, a dome of that radius at a tip."""
    near = min(max(0.5 + (half - u) / soft, 0.0), 1.0)
    depth = u + half
    if dome > 0:
        rim = 1.0 - min(max(depth / dome, 0.0), 1.0)
        return near * np.sqrt(1.0 - rim * rim)
    return near * min(max(0.5 + depth / soft, 0.0), 1.0)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _cylinder(v, radius):  # type: ignore[no-untyped-def]  # pragma: no cover
    return np.sqrt(max(1.0 - (v / radius) ** 2, 0.0))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _best_shift(profile, step, half, reach, dome, soft, chord, window):  # type: ignore[no-untyped-def]  # pragma: no cover
    """(shift, its standard deviation, unexplained share of the profile's variance) of the darkest matching template."""
    n = profile.size
    middle = 0.5 * (n - 1)
    shifts = 2 * int(reach / step) + 1
    scores = np.empty(shifts)
    best = -1e30
    chosen = 0
    rest = 1.0
    sd = 10.0
    for k in range(shifts):
        shift = (k - shifts // 2) * step
        st = sp = stp = stt = spp = sdd = 0.0
        m = 0
        previous = 0.0
        for i in range(n):
            u = (i - middle) * step - shift
            if abs(u) > window:
                continue
            t = _cylinder(u, half) if chord else _band(u, half, dome, soft)
            p = -profile[i]
            st += t
            sp += p
            stp += t * p
            stt += t * t
            spp += p * p
            if m > 0:
                sdd += (t - previous) ** 2
            previous = t
            m += 1
        vt = max(stt - st * st / m, 1e-9)
        vp = max(spp - sp * sp / m, 1e-12)
        c = stp - st * sp / m
        scores[k] = c / np.sqrt(vt)
        if scores[k] > best:
            best = scores[k]
            chosen = k
            amplitude = max(c / vt, 1e-9)
            rest = max(1.0 - max(c, 0.0) ** 2 / (vt * vp), 0.0)
            # Cramer-Rao bound of a shift in white noise; samples half a pixel apart share theirs.
            sd = np.sqrt(2.0 * rest * vp / m / max(sdd / (step * step), 1e-9)) / amplitude
    fine = 0.0
    if 0 < chosen < shifts - 1:
        curvature = scores[chosen - 1] - 2 * scores[chosen] + scores[chosen + 1]
        if curvature < 0:
            fine = 0.5 * (scores[chosen - 1] - scores[chosen + 1]) / curvature
    return (chosen - shifts // 2 + fine) * step, sd, rest


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _fit_band(x, u, v, au, av, half, radius, reach, dome, window, step, soft):  # type: ignore[no-untyped-def]  # pragma: no cover
    n = 2 * int((window + reach) / step) + 1
    profile = np.zeros(n)
    lines = max(1, int(1.5 * radius))
    for i in range(n):
        s = (i - 0.5 * (n - 1)) * step
        for k in range(lines):
            w = 1.5 * radius * ((k + 0.5) / lines - 0.5)
            profile[i] += _sample(x, u + s * au - w * av, v + s * av + w * au)
    profile /= lines
    shift, sd_along, rest = _best_shift(profile, step, half, reach, dome, soft, False, window)
    u += shift * au
    v += shift * av
    sideways = min(reach, 3.5)
    n = 2 * int((radius + 4.0 + sideways) / step) + 1
    profile = np.zeros(n)
    lines = max(1, int(2 * half))
    for i in range(n):
        w = (i - 0.5 * (n - 1)) * step
        for k in range(lines):
            s = 2 * half * ((k + 0.5) / lines - 0.5)
            profile[i] += _sample(x, u + s * au - w * av, v + s * av + w * au)
    profile /= lines
    shift, sd_across, _ = _best_shift(profile, step, radius, sideways, 0.0, soft, True, radius + 4.0)
    return u - shift * av, v + shift * au, sd_along, sd_across, rest
