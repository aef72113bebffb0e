"""Spacings of electrodes: how likely the visible gaps of a chain are for a catheter."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES
from fluoromap.segmenter.shape.loops import loop_fit

_LARGEST_LOOP = 1.3
"""Size of the largest loop of a type, in that of the type."""

_SPACING_SD, _LOOP_SPACING_SD = 0.06, 0.12
"""Of the ratio between visible and true spacing. Loops are made in several sizes, and some can be tightened."""
_TREND_SD_PER_MM, _MOST_TREND_SD = 0.045, 0.9
_DRIFT_SD_PER_MM, _LEAST_SLOPE = 0.03, 0.15
_LOOP_DRIFT = 0.8
"""How fast the foreshortening of a loop changes, as a part of its curvature."""


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


def shape_fit(points_uv: Array, variance_px2: Array, catheter: Catheter, px_per_mm: float) -> Array:
    """Return the log-likelihood of each chain's shape for this catheter, (n,).

    That is the shape of its spacings, and of a loop's bends. One foreshortening is free. The likelihood lacks a constant.
    ``points_uv`` are (n, electrodes, 2).
    """
    spacing_px, curvature = spacing_px_of(catheter, px_per_mm), catheter.curvature_per_mm
    fit = spacing_fit(points_uv, spacing_px, variance_px2, curvature, px_per_mm)
    fit += loop_fit(points_uv, spacing_px, curvature, px_per_mm)
    return fit


def searched_spacing_px(catheter: Catheter, px_per_mm: float) -> Array:
    """Return the spacings for which chains are searched, (electrodes - 1,) pixels at the isocentre.

    A loop may be larger than its type says: loops are made in several sizes.
    """
    return spacing_px_of(catheter, px_per_mm) * (_LARGEST_LOOP if catheter.is_circular else 1.0)


def spacing_px_of(catheter: Catheter, px_per_mm: float) -> Array:
    """Return the catalogue's spacings, (electrodes - 1,) pixels at the isocentre."""
    return np.asarray(catheter.spacing_mm, dtype=np.float64) * px_per_mm
