"""Step 1 of the four-step filter: homomorphic filtering, equation (4)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fluoromap.segmenter.log_image import Image


def homomorphic(x: Image, low: float = 0.5, high: float = 2.0, slope: float = 1.0, cutoff: float = 8.0) -> Image:
    """Homomorphic filter of a log image, equation (4): slow shading is damped, detail is raised.

    The transfer function H(D) = (high - low)(1 - exp(-slope D^2 / cutoff^2)) + low, with D in cycles per image width, is
    ``high`` minus a Gaussian, so that no Fourier transform is needed:
    H applied to x is ``high x - (high - low) G * x`` with the width of :func:`equivalent_sigma`.
    Edges are reflected; (1 - low) times the mean is added back, so that H(0) = 1 and the mean level stays.
    The exponential that ends a textbook homomorphic filter is monotone and left out.

    Parameters
    ----------
    x : (rows, columns) float32
        Logarithm of the intensity.
    low, high, slope, cutoff : float
        gamma_L, gamma_H, c and D0 of the paper.

    Returns
    -------
    (rows, columns) float32, log units.
    """
    background = gaussian(x, equivalent_sigma(x.shape[1], slope, cutoff))
    level = np.float32((1.0 - low) * float(x.mean(dtype=np.float64)))
    filtered: Image = np.float32(high) * x - np.float32(high - low) * background + level
    return filtered


def equivalent_sigma(width: int, slope: float, cutoff: float) -> float:
    """Standard deviation in pixels of the Gaussian hidden in equation (4): N sqrt(c) / (pi sqrt(2) D0)."""
    return width * math.sqrt(slope) / (math.pi * math.sqrt(2.0) * cutoff)


def gaussian(x: Image, sigma: float) -> Image:
    """Gaussian blur with reflected edges, one pass along columns and one along rows; large sigmas on a reduced image.

    The reduction by area means and the linear enlargement add variance of their own, which is taken off the sigma; what
    remains is an error of about 1e-3 of the range.
    """
    if sigma <= 0:
        return x.copy()
    factor = 1
    while sigma / factor >= 7.0 and min(x.shape) >= 16 * factor:
        factor *= 2
    if factor == 1:
        return _blur(x, _taps(sigma))
    small = reduce_by(x, factor)
    added = (factor**2 - 1) / 12.0 + factor**2 / 6.0
    out = np.empty(x.shape, np.float32)
    _enlarge(_blur(small, _taps(math.sqrt(sigma**2 - added) / factor)), factor, out)
    return out


def reduce_by(x: Image, factor: int) -> Image:
    """Area means over ``factor`` x ``factor`` pixels; what does not fill a last cell repeats the edge."""
    rows, columns = -(-x.shape[0] // factor), -(-x.shape[1] // factor)
    if (rows * factor, columns * factor) != x.shape:
        x = np.pad(x, ((0, rows * factor - x.shape[0]), (0, columns * factor - x.shape[1])), mode="edge")
    out = np.empty((rows, columns), np.float32)
    _area_means(np.ascontiguousarray(x, dtype=np.float32), factor, out)
    return out


def _taps(sigma: float) -> Image:
    """Half of a normalised Gaussian kernel cut at 4 sigma: weight of the middle, then of distance 1, 2, ..."""
    reach = max(1, math.ceil(4.0 * sigma))
    weights = np.exp(-0.5 * (np.arange(reach + 1) / sigma) ** 2)
    weights /= weights[0] + 2.0 * weights[1:].sum()
    return weights.astype(np.float32)


def _blur(x: Image, taps: Image) -> Image:
    reach = taps.size - 1
    down = np.empty_like(x)
    _blur_down(np.pad(x, ((reach, reach), (0, 0)), mode="symmetric"), taps, down)
    across = np.empty_like(x)
    _blur_across(np.pad(down, ((0, 0), (reach, reach)), mode="symmetric"), taps, across)
    return across


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _add_pair(out, first, second, weight):  # type: ignore[no-untyped-def]  # pragma: no cover
    for u in range(out.size):
        out[u] += weight * (first[u] + second[u])


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _blur_down(padded, taps, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    reach = taps.size - 1
    for v in range(out.shape[0]):
        row = out[v]
        middle = padded[v + reach]
        for u in range(row.size):
            row[u] = taps[0] * middle[u]
        for k in range(1, taps.size):
            _add_pair(row, padded[v + reach - k], padded[v + reach + k], taps[k])


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _blur_across(padded, taps, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    reach = taps.size - 1
    width = out.shape[1]
    for v in range(out.shape[0]):
        row = out[v]
        source = padded[v]
        middle = source[reach : reach + width]
        for u in range(width):
            row[u] = taps[0] * middle[u]
        for k in range(1, taps.size):
            _add_pair(row, source[reach - k : reach - k + width], source[reach + k : reach + k + width], taps[k])


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _area_means(x, factor, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = out.shape
    scale = np.float32(1.0 / (factor * factor))
    sums = np.empty(x.shape[1], np.float32)
    for v in range(rows):
        sums[:] = x[v * factor]
        for k in range(1, factor):
            sums += x[v * factor + k]
        for u in range(columns):
            total = np.float32(0)
            for k in range(factor):
                total += sums[u * factor + k]
            out[v, u] = total * scale


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _enlarge(small, factor, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Linear interpolation between the centres of the reduced pixels."""
    rows, columns = small.shape
    left = np.empty(out.shape[1], np.int64)
    share = np.empty(out.shape[1], np.float32)
    for u in range(out.shape[1]):
        place = min(max((u + 0.5) / factor - 0.5, 0.0), columns - 1.0)
        left[u] = min(int(place), columns - 2) if columns > 1 else 0
        share[u] = place - left[u]
    step = 1 if columns > 1 else 0
    line = np.empty(columns, np.float32)
    for v in range(out.shape[0]):
        place = min(max((v + 0.5) / factor - 0.5, 0.0), rows - 1.0)
        top = min(int(place), rows - 2) if rows > 1 else 0
        below = top + 1 if rows > 1 else top
        lower = np.float32(place - top)
        for u in range(columns):
            line[u] = small[top, u] + lower * (small[below, u] - small[top, u])
        for u in range(out.shape[1]):
            first = line[left[u]]
            out[v, u] = first + share[u] * (line[left[u] + step] - first)
