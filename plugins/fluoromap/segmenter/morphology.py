"""Step 4 of the four-step filter: grey-level morphology with disks."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fluoromap.contracts import IntArray
from fluoromap.segmenter.log_image import Image

Levels = NDArray[np.uint16]

_LEVELS = 65536


def disk_morphology(x: Image, background_px: int = 14, opening_px: int = 2) -> Image:
    """Dark things that a disk of ``background_px`` does not fit into and one of ``opening_px`` does, as bright ones.

    Closing by the large disk minus the image (black top-hat), then opening by the small one. Radii are in pixels at the
    heart: the large one must exceed half an electrode's length, the small one stay within half a ring's.

    Worked out on 65536 grey levels between the extremes of ``x``: rank filters are several times faster on short integers.
    """
    low, high = float(x.min()), float(x.max())
    scale = (_LEVELS - 1) / (high - low) if high > low else 1.0
    levels = ((x - np.float32(low)) * np.float32(scale)).astype(np.uint16)
    hat = closing(levels, background_px) - levels
    return opening(hat, opening_px).astype(np.float32) * np.float32(1.0 / scale)


def disk(radius: int) -> NDArray[np.bool_]:
    """Pixels whose centres lie within ``radius`` of the middle one, shape (2 radius + 1, 2 radius + 1)."""
    v, u = np.ogrid[-radius : radius + 1, -radius : radius + 1]
    inside: NDArray[np.bool_] = u * u + v * v <= radius * radius
    return inside


def closing(x: Levels, radius: int) -> Levels:
    return erode(dilate(x, radius), radius)


def opening(x: Levels, radius: int) -> Levels:
    return dilate(erode(x, radius), radius)


def dilate(x: Levels, radius: int) -> Levels:
    """Largest value under an exact disk; what lies outside the image does not count."""
    if radius < 1:
        return x.copy()
    out = np.zeros((x.shape[0] + 2 * radius, x.shape[1]), np.uint16)
    _dilate(np.pad(x, ((0, 0), (radius, radius))), _half_widths(radius), out)
    return out[radius:-radius]


def erode(x: Levels, radius: int) -> Levels:
    """Smallest value under an exact disk; what lies outside the image does not count."""
    return ~dilate(~x, radius)


def _half_widths(radius: int) -> IntArray:
    """Half width of the disk's row at distance 0, 1, ... radius from its middle."""
    return np.array([math.isqrt(radius**2 - k**2) for k in range(radius + 1)], dtype=np.int64)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _larger(out, first, second):  # type: ignore[no-untyped-def]  # pragma: no cover
    for u in range(out.size):
        out[u] = max(first[u], second[u])


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _raise(out, other):  # type: ignore[no-untyped-def]  # pragma: no cover
    for u in range(out.size):
        out[u] = max(out[u], other[u])


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _dilate(padded, half_widths, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Each row is widened to every width of the disk, by windows of 1, 2, 4, ... pixels overlapped in pairs, and raises the
    rows above and below that the disk reaches with that width. ``out`` has ``radius`` spare rows at both ends."""
    rows, width = padded.shape
    radius = half_widths.size - 1
    columns = width - 2 * radius
    levels = 1
    while (1 << levels) <= 2 * radius + 1:
        levels += 1
    windows = np.empty((levels, width), np.uint16)
    wide = np.empty(columns, np.uint16)
    for v in range(rows):
        windows[0] = padded[v]
        for level in range(1, levels):
            shift = 1 << (level - 1)
            source = windows[level - 1]
            _larger(windows[level][: width - shift], source[: width - shift], source[shift:])
        done = -1
        for k in range(radius, -1, -1):
            half = half_widths[k]
            if half != done:
                span = 2 * half + 1
                level = 0
                while (2 << level) <= span:
                    level += 1
                source = windows[level]
                first = radius - half
                second = radius + half + 1 - (1 << level)
                _larger(wide, source[first : first + columns], source[second : second + columns])
                done = half
            _raise(out[v + radius - k], wide)
            if k > 0:
                _raise(out[v + radius + k], wide)
