"""Step 2 of the four-step filter: Perona-Malik diffusion, equations (5) and (6)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fluoromap.contracts import BoolArray
from fluoromap.segmenter.picture.log_image import Image, central_range

STABLE_STEP = 0.25
"""Limit of the time step of explicit four-neighbour diffusion: at this step a checkerboard never fades."""

_FLOOR = 1e-3
_GAUSSIAN_SD = 1.4826


def edge_scale(x: Image, inside: BoolArray, factor: float = 2.0) -> float | None:
    """Return K of equation (6) from the noise, or None for a flat frame.

    K is ``factor`` x 1.4826 x the median |horizontal difference| inside the mask. On coarsely quantised frames the
    median is 0. K is therefore at least a thousandth of the spread of x.
    """
    ends = central_range(x, inside)
    if ends is None:
        return None
    rows = x[::16]
    differences = np.abs(rows[:, 1:] - rows[:, :-1])[inside[::16, 1:] & inside[::16, :-1]]
    middle = differences.size // 2
    median = float(np.partition(differences, middle)[middle]) if differences.size else 0.0
    return max(factor * _GAUSSIAN_SD * median, _FLOOR * (ends[1] - ends[0]))


def perona_malik(x: Image, k: float, sweeps: int = 15, step: float = 0.2) -> Image:
    """Apply Perona-Malik diffusion, eq. (5) of the paper, with the conduction of :func:`_flux`.

    Four neighbours, explicit steps, no flux through the image border. All sweeps run as one wavefront over the rows, in
    place: sweep n + 1 visits a row as soon as sweep n has left the row below, while both are in the cache.

    Parameters
    ----------
    x : (rows, columns) float32
    k : float
        Differences well above this are edges and stay; unit of ``x``.
    sweeps : int
    step : float
        Below :data:`STABLE_STEP`.

    Returns
    -------
    (rows, columns) float32
        Within 0.005 of the range of a double precision sweep-by-sweep evaluation.
    """
    if not 0 < step < STABLE_STEP:
        raise ValueError(f"the step of the diffusion is {step}: it must lie between 0 and {STABLE_STEP}")
    # In this unit the conduction is exp(-8 d^2), the eighth power of a series in d^2.
    unit = np.float32(math.sqrt(8.0) * k)
    out: Image = np.ascontiguousarray(x * (np.float32(1) / unit), dtype=np.float32)
    _diffuse(out, sweeps, np.float32(step))
    out *= unit
    return out


@njit(inline="always")
def _flux(d):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return d times the conduction exp(-(d/K)^2), eq. (6) of the paper.

    d is in the unit in which the product is d exp(-8 d^2). The error is 1e-4 of the largest value. The exponential is
    the eighth power of a cubic in d^2, best over 0 <= 8 d^2 <= 10; beyond, the flux is 0. Library calls would break
    vectorisation.
    """
    y = min(d * d, np.float32(1.3))
    series = np.float32(0.49140077) - np.float32(0.13123593) * y
    series = np.float32(1) - y * (np.float32(0.99949358) - y * series)
    series *= series
    series *= series
    return d * (series * series)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _diffuse_row(row, below, north, flow, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do one sweep over one row.

    ``north`` holds the flux from above and, afterwards, the flux below. ``flow`` holds the fluxes through the vertical
    pixel faces; its ends stay 0.
    """
    n = row.size
    right, west, east = row[1:], flow[:n], flow[1:]
    for u in range(n - 1):
        east[u] = _flux(right[u] - row[u])
    for u in range(n):
        south = _flux(below[u] - row[u])
        row[u] += step * (south - north[u] + east[u] - west[u])
        north[u] = south


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _diffuse(x, sweeps, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = x.shape
    north = np.zeros((sweeps, columns), np.float32)
    flow = np.zeros(columns + 1, np.float32)
    for front in range(rows + sweeps - 1):
        for sweep in range(max(0, front - rows + 1), min(sweeps, front + 1)):
            v = front - sweep
            _diffuse_row(x[v], x[min(v + 1, rows - 1)], north[sweep], flow, step)
