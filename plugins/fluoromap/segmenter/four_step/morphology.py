"""Step 4 of the four-step filter: grey-level morphology with disks.

scikit-image's closing with a disk of 14 px takes 260 times as long (40 times with a decomposed disk), its opening with
2 px 16 times.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fluoromap.contracts import IntArray
from fluoromap.segmenter.picture.log_image import Image

Levels = NDArray[np.uint16]

_LEVELS = 65536


def disk_morphology(x: Image, background_px: int = 14, opening_px: int = 2) -> Image:
    """Return dark things between the two disk sizes as bright ones.

    The closing by the large disk minus the image (black top-hat) keeps dark things that the large disk does not fit
    into. The opening by the small disk removes those that it does not fit into. Radii are in pixels at the heart: the
    large one must exceed half an electrode's length, the small one must be at most half a ring's length.

    The image is mapped to 65536 grey levels between its extremes: rank filters are several times faster on short integers.
    """
    low, high = float(x.min()), float(x.max())
    scale = (_LEVELS - 1) / (high - low) if high > low else 1.0
    levels = ((x - np.float32(low)) * np.float32(scale)).astype(np.uint16)
    hat = closing(levels, background_px) - levels
    return opening(hat, opening_px).astype(np.float32) * np.float32(1.0 / scale)


def closing(x: Levels, radius: int) -> Levels:
    """Dilate, then erode."""
    return erode(dilate(x, radius), radius)


def opening(x: Levels, radius: int) -> Levels:
    """Erode, then dilate."""
    return dilate(erode(x, radius), radius)


def dilate(x: Levels, radius: int) -> Levels:
    """Return the largest value under an exact disk.

    Pixels outside the image do not count.
    """
    if radius < 1:
        return x.copy()
    out = np.empty(x.shape, np.uint16)
    _dilate(x, _half_widths(radius), out)
    return out


def erode(x: Levels, radius: int) -> Levels:
    """Return the smallest value under an exact disk.

    Pixels outside the image do not count.
    """
    return ~dilate(~x, radius)


def _half_widths(radius: int) -> IntArray:
    """Return the half widths of the disk's rows, from its middle outwards."""
    return np.array([math.isqrt(radius**2 - k**2) for k in range(radius + 1)], dtype=np.int64)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _larger(first, second, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for u in range(min(second.size, out.size)):
        out[u] = max(first[u], second[u])


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _raise(out, rows, first, second, outer_rows, outer_first, outer_second):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Raise a row to two windows each of four other rows.

    These are the windows that begin at ``first`` and ``second`` in the row above and the row below, and likewise in an
    outer pair of rows. Four rows at once: each call costs as much as a row.
    """
    above, below = rows
    outer_above, outer_below = outer_rows
    a, b, c, d = above[first:], above[second:], below[first:], below[second:]
    e, f, g, h = (
        outer_above[outer_first:], outer_above[outer_second:], outer_below[outer_first:], outer_below[outer_second:],
    )  # fmt: skip
    for u in range(out.size):
        inner = max(max(a[u], b[u]), max(c[u], d[u]))
        outer = max(max(e[u], f[u]), max(g[u], h[u]))
        out[u] = max(out[u], max(inner, outer))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _dilate(x, half_widths, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Dilate by a disk, row by row.

    Each row is widened once by windows of 1, 2, 4, ... pixels and stored while it is in reach. A row of the result is
    the largest of the rows round it, each widened to its row of the disk by two overlapping windows of one size.
    """
    rows, columns = x.shape
    radius = half_widths.size - 1
    depth, width = 2 * radius + 1, columns + 2 * radius
    level_of = np.empty(radius + 1, np.int64)
    for k in range(radius + 1):
        level_of[k] = 0
        while (2 << level_of[k]) <= 2 * half_widths[k] + 1:
            level_of[k] += 1
    windows = np.empty((depth, level_of[0] + 1, width), np.uint16)
    windows[:] = 0
    for front in range(rows + radius):
        newest = windows[front % depth]
        if front < rows:
            pixels, middle = x[front], newest[0, radius:]
            for u in range(columns):
                middle[u] = pixels[u]
            for level in range(1, level_of[0] + 1):
                _larger(newest[level - 1], newest[level - 1, 1 << (level - 1) :], newest[level])
        else:
            newest[:] = 0
        v = front - radius
        if v >= 0:
            widest = windows[v % depth, level_of[0]]
            _larger(widest, widest[2 * radius + 1 - (1 << level_of[0]) :], out[v])
            for k in range(1, radius + 1, 2):
                m = min(k + 1, radius)
                _raise(
                    out[v],
                    (windows[(v - k) % depth, level_of[k]], windows[(v + k) % depth, level_of[k]]),
                    radius - half_widths[k],
                    radius + half_widths[k] + 1 - (1 << level_of[k]),
                    (windows[(v - m) % depth, level_of[m]], windows[(v + m) % depth, level_of[m]]),
                    radius - half_widths[m],
                    radius + half_widths[m] + 1 - (1 << level_of[m]),
                )
