"""The shape of a long row of electrodes: in space its direction changes smoothly.

What the image shows of a catheter's direction is two coordinates of a unit vector. Each is a smooth function along the catheter,
and so is its integral, the place. Both are taken as Gaussian processes. A bend through the viewing direction, where electrodes
merge and the row turns back, is then as likely as a bend across it.
"""

from __future__ import annotations

import functools

import numpy as np
from numba import njit

from fluoromap.contracts import Array, frozen

_BEND_LENGTH_MM, _DIRECTION_VARIANCE = 15.0, 0.5
"""Of the direction's squared-exponential covariance along the catheter: within this length it changes about by its own size."""
_SPACING_SD, _PLACE_SD_MM = 0.05, 0.25
"""What spacings differ from the catalogue's, as a share, and places from the middle of their electrode."""
_SEEN_SD_MM = 0.2
_STEP_MM = 0.1


@functools.lru_cache(maxsize=64)
def shape_covariance_mm2(spacing_mm: tuple[float, ...], curvature_per_mm: float) -> Array:
    """Return the covariance of one coordinate of a smooth curve at the electrodes, (electrodes, electrodes).

    The first electrode lies at 0. Spacings are those from the tip on. A loop has the curvature of its circle: its direction turns
    by that on the way, whatever side it is seen from.
    """
    arc = np.concatenate([[0.0], np.cumsum(spacing_mm)])
    steps = np.arange(0.0, arc[-1], _STEP_MM) + 0.5 * _STEP_MM
    apart = steps[:, None] - steps
    alike = np.cos(curvature_per_mm * apart) * np.exp(-0.5 * (apart / _BEND_LENGTH_MM) ** 2)
    if not curvature_per_mm:
        # Beyond what is seen a catheter goes straight on.
        alike += 1.0
    up_to = np.clip((arc[:, None] - steps) / _STEP_MM + 0.5, 0.0, 1.0) * _STEP_MM
    passed = np.tril(np.ones((len(arc), len(arc))), -1)[:, :-1] * np.asarray(spacing_mm)
    covariance = _DIRECTION_VARIANCE * up_to @ alike @ up_to.T + _SPACING_SD**2 * passed @ passed.T
    return frozen(covariance, covariance.shape, "covariance")


@functools.lru_cache(maxsize=64)
def place_covariance_mm2(spacing_mm: tuple[float, ...], curvature_per_mm: float) -> Array:
    """Return the covariance of one coordinate of the electrodes' places, (electrodes, electrodes).

    They lie about the curve of :func:`shape_covariance_mm2`.
    """
    covariance = shape_covariance_mm2(spacing_mm, curvature_per_mm)
    return frozen(covariance + _PLACE_SD_MM**2 * np.eye(len(covariance)), covariance.shape, "covariance")


def row_fit(places: Array, spacing_mm: tuple[float, ...], variance_px2: Array, px_per_mm: float) -> Array:
    """Return the log-likelihood of each row's shape up to a constant, (n,).

    Parameters
    ----------
    places : (n, electrodes, 2)
        Pixels, from the tip on.
    spacing_mm : tuple of float
        From the tip on.
    variance_px2 : (n, electrodes)
        Of each coordinate of a place.
    px_per_mm : float
        At the isocentre.
    """
    out = np.empty(len(places))
    covariance = place_covariance_mm2(spacing_mm, 0.0) * px_per_mm**2
    gaps = np.diff(np.diff(covariance, axis=0), axis=1)
    _fit_shapes(np.ascontiguousarray(np.diff(places, axis=1)), np.ascontiguousarray(variance_px2), gaps, out)
    return out


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _fit_shapes(gaps, variance_px2, covariance, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write half of the gaps' squared Mahalanobis lengths, negative.

    The factor of the covariance is computed row by row, with the gaps divided by it.
    """
    m = covariance.shape[0]
    factor = np.zeros((m, m))
    away = np.empty((m, 2))
    for row in range(gaps.shape[0]):
        total = 0.0
        for i in range(m):
            du, dv = gaps[row, i, 0], gaps[row, i, 1]
            for j in range(i + 1):
                value = covariance[i, j]
                if j == i:
                    value += variance_px2[row, i] + variance_px2[row, i + 1]
                elif j == i - 1:
                    value -= variance_px2[row, i]
                for k in range(j):
                    value -= factor[i, k] * factor[j, k]
                if j < i:
                    value /= factor[j, j]
                    factor[i, j] = value
                    du -= value * away[j, 0]
                    dv -= value * away[j, 1]
                else:
                    factor[i, i] = np.sqrt(value)
            away[i, 0], away[i, 1] = du / factor[i, i], dv / factor[i, i]
            total += away[i, 0] * away[i, 0] + away[i, 1] * away[i, 1]
        out[row] = -0.5 * total


def smooth_places(
    places: Array, spacing_mm: tuple[float, ...], curvature_per_mm: float, variance_px2: Array, px_per_mm: float
) -> Array:
    """Return the most probable places of electrodes, (n, electrodes, 2).

    They were seen at ``places`` with these variances. An electrode that was not seen has an infinite variance. The parameters are
    those of :func:`row_fit`.
    """
    weights = 1.0 / variance_px2
    covariance = place_covariance_mm2(spacing_mm, curvature_per_mm) * px_per_mm**2
    # With this variance the first place is free.
    precision = np.linalg.inv(covariance + 1e6)
    whole = precision + weights[:, None, :] * np.eye(len(covariance))
    centre = (weights[..., None] * places).sum(axis=1, keepdims=True) / weights.sum(axis=1)[:, None, None]
    smooth: Array = np.linalg.solve(whole, weights[..., None] * (places - centre)) + centre
    return smooth


@functools.lru_cache(maxsize=256)
def next_place(spacing_mm: tuple[float, ...], curvature_per_mm: float, known: int) -> tuple[Array, float]:
    """Return how the next electrode's place follows from the first ``known`` ones.

    Returns
    -------
    coefficients : (known,)
        Weights of their places.
    sd_mm : float
        Standard deviation of a coordinate from that prediction.
    """
    covariance = place_covariance_mm2(spacing_mm, curvature_per_mm)[: known + 1, : known + 1] + 1e4
    seen = covariance[:known, :known] + _SEEN_SD_MM**2 * np.eye(known)
    weights = np.linalg.solve(seen, covariance[:known, known])
    left = covariance[known, known] - weights @ covariance[:known, known] + _SEEN_SD_MM**2
    return frozen(weights / weights.sum(), (known,), "coefficients"), float(np.sqrt(left))
