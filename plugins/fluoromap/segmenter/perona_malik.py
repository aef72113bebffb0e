"""Step 2 of the four-step filter: Perona-Malik diffusion, equations (5) and (6)."""

from __future__ import annotations

import numpy as np
from numba import njit

from fluoromap.contracts import BoolArray
from fluoromap.segmenter.log_image import Image

STABLE_STEP = 0.25
"""Explicit four-neighbour diffusion must stay below this time step: at it a checkerboard survives for ever."""

_FLOOR = 1e-3
_GAUSSIAN_SD = 1.4826


def edge_scale(x: Image, inside: BoolArray, factor: float = 2.0) -> float | None:
    """K of equation (6) from the noise: ``factor`` x 1.4826 x the median |horizontal difference| inside the mask.

    On coarsely quantised frames the median is 0; then, and where it is smaller, a thousandth of the spread of x takes its
    place. None for a flat frame, which has nothing to diffuse.
    """
    values = x[::4, ::4][inside[::4, ::4]]
    if values.size < 2:
        return None
    low, high = np.percentile(values, [0.5, 99.5])
    spread = float(high - low)
    if not spread > 0:
        return None
    rows = x[::8]
    differences = np.abs(rows[:, 1:] - rows[:, :-1])[inside[::8, 1:] & inside[::8, :-1]]
    median = float(np.median(differences)) if differences.size else 0.0
    return max(factor * _GAUSSIAN_SD * median, _FLOOR * spread)


def perona_malik(x: Image, k: float, sweeps: int = 15, step: float = 0.2) -> Image:
    """Perona-Malik diffusion, equation (5) with the conduction exp(-(d/K)^2) of equation (6).

    Four neighbours, explicit steps, no flux through the image border. All sweeps run as one wavefront over the rows, in
    place: a row is visited by sweep n + 1 as soon as its lower neighbour has left sweep n, while both are in the cache.

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
    (rows, columns) float32, within 0.005 of the range of a double precision sweep-by-sweep evaluation.
    """
    if not 0 < step < STABLE_STEP:
        raise ValueError("the step of the diffusion must lie between 0 and 0.25")
    out = np.array(x, dtype=np.float32, order="C")
    _diffuse(out, sweeps, np.float32(1.0 / k**2), np.float32(step))
    return out


@njit(inline="always")
def _conduction(square):  # type: ignore[no-untyped-def]  # pragma: no cover
    """exp(-square) to 1e-4: the eighth power of a short series; library calls would break vectorisation."""
    y = np.float32(0.125) * min(square, np.float32(8))
    series = np.float32(1.0 / 6) - np.float32(1.0 / 24) * y
    series = np.float32(1) - y * (np.float32(1) - y * (np.float32(0.5) - y * series))
    series *= series
    series *= series
    return series * series


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _diffuse_row(row, right, below, north, west, east, south, inverse, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    """One sweep over one row; ``north`` holds the flux from above and leaves with the flux below. ``west`` and ``east`` are
    views of one array, the fluxes through the vertical pixel faces; ``right`` is the row shifted by a pixel."""
    for u in range(right.size):
        d = right[u] - row[u]
        east[u] = d * _conduction(d * d * inverse)
    for u in range(row.size):
        d = below[u] - row[u]
        south[u] = d * _conduction(d * d * inverse)
    for u in range(row.size):
        row[u] += step * (south[u] - north[u] + east[u] - west[u])
    for u in range(row.size):
        north[u] = south[u]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _diffuse(x, sweeps, inverse, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = x.shape
    north = np.zeros((sweeps, columns), np.float32)
    flow = np.zeros(columns + 1, np.float32)
    south = np.empty(columns, np.float32)
    for front in range(rows + sweeps - 1):
        for sweep in range(max(0, front - rows + 1), min(sweeps, front + 1)):
            v = front - sweep
            row = x[v]
            below = x[min(v + 1, rows - 1)]
            _diffuse_row(row, row[1:], below, north[sweep], flow[:-1], flow[1:], south, inverse, step)
