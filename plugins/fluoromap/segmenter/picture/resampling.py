"""A frame reduced to the scale of the network, by area means over any factor, and frames moved onto each other."""

from __future__ import annotations

import functools
import math

import numpy as np

from fluoromap.contracts import Array, IntArray
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.log_image import Image


def resampled(x: Image, scale: float) -> Image:
    """Return the picture at ``scale`` times its size.

    It is enlarged linearly, or reduced by area means. Pixel j of the answer has its centre at (j + 0.5) / scale - 0.5
    of the picture.
    """
    if scale == 1.0:
        return x
    rows, columns = (max(8, math.ceil(size * scale)) for size in x.shape)
    # Across the rows first: that loop is the fast one, and a reduction leaves fewer rows for the other.
    half = np.empty((rows, x.shape[1]), np.float32)
    _across_rows(np.ascontiguousarray(x, dtype=np.float32), *_shares(x.shape[0], rows, scale), half)
    out = np.empty((rows, columns), np.float32)
    _along_rows(half, *_shares(x.shape[1], columns, scale), out)
    return out


@functools.lru_cache(maxsize=16)
def _shares(size: int, count: int, scale: float) -> tuple[IntArray, Image]:
    """Return the first pixel of each mean, (count,), and its weights.

    The weights (count, taps) are those of the pixels from there on; rows add up to 1.
    """
    middle = (np.arange(count) + 0.5) / scale - 0.5
    # A box as wide as the new pixel; a triangle between pixels where the picture is enlarged.
    half = 0.5 * max(1.0 / scale, 1.0)
    taps = math.ceil(2.0 * half) + 2
    first = np.floor(middle - half).astype(np.int64)
    places = first[:, None] + np.arange(taps)
    if scale < 1.0:
        overlap = np.minimum(places + 0.5, (middle + half)[:, None]) - np.maximum(
            places - 0.5, (middle - half)[:, None]
        )
        weights = np.maximum(overlap, 0.0)
    else:
        weights = np.maximum(1.0 - np.abs(places - middle[:, None]), 0.0)
    inside = (places >= 0) & (places < size)
    weights = np.where(inside, weights, 0.0)
    empty = weights.sum(axis=1) == 0
    first = np.clip(first, 0, max(size - taps, 0))
    shifted = np.zeros_like(weights)
    for row in range(count):
        if empty[row]:
            shifted[row, min(taps, size) - 1] = 1.0
            continue
        for tap in np.flatnonzero(weights[row]):
            shifted[row, places[row, tap] - first[row]] = weights[row, tap]
    shifted /= shifted.sum(axis=1, keepdims=True)
    return first, shifted[:, : min(taps, size)].astype(np.float32)


@kernel("f4[:,::1], i8[::1], f4[:,::1], f4[:,::1]")
def _along_rows(x, first, weights, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    if weights.shape[1] == 4:
        # A reduction by less than 2, as of most runs: without the inner loop it takes a third of the time.
        for v in range(out.shape[0]):
            line = x[v]
            for u in range(out.shape[1]):
                at = first[u]
                out[v, u] = (
                    weights[u, 0] * line[at]
                    + weights[u, 1] * line[at + 1]
                    + weights[u, 2] * line[at + 2]
                    + weights[u, 3] * line[at + 3]
                )
        return
    for v in range(out.shape[0]):
        line = x[v]
        for u in range(out.shape[1]):
            total = np.float32(0)
            for k in range(weights.shape[1]):
                total += weights[u, k] * line[first[u] + k]
            out[v, u] = total


@kernel("f4[:,::1], i8[::1], f4[:,::1], f4[:,::1]")
def _across_rows(x, first, weights, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for v in range(out.shape[0]):
        target = out[v]
        for u in range(target.size):
            target[u] = np.float32(0)
        for k in range(weights.shape[1]):
            weight = weights[v, k]
            line = x[first[v] + k]
            for u in range(target.size):
                target[u] += weight * line[u]


def add_moved(image: Image, turn: Array, shift: Array, total: Image) -> None:
    """Add to each pixel (u, v) of ``total`` the image at ``turn`` (u, v) + ``shift``.

    The image is linear between its pixels. Places outside get the nearest pixel.
    """
    _add_moved(image, turn, shift, total)


@kernel("f4[:,::1], f8[:,::1], f8[::1], f4[:,::1]", fastmath=False)
def _add_moved(image, turn, shift, total):  # type: ignore[no-untyped-def]  # pragma: no cover
    last_u, last_v = image.shape[1] - 1.0, image.shape[0] - 1.0
    for row in range(total.shape[0]):
        for column in range(total.shape[1]):
            u = min(max(turn[0, 0] * column + turn[0, 1] * row + shift[0], 0.0), last_u)
            v = min(max(turn[1, 0] * column + turn[1, 1] * row + shift[1], 0.0), last_v)
            left, top = int(u), int(v)
            right, below = min(left + 1, image.shape[1] - 1), min(top + 1, image.shape[0] - 1)
            across, down = u - left, v - top
            upper = image[top, left] + across * (image[top, right] - image[top, left])
            lower = image[below, left] + across * (image[below, right] - image[below, left])
            total[row, column] += upper + down * (lower - upper)
