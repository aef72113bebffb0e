"""Means of successive frames, each moved along a velocity: a catheter with this velocity is clear, the rest is blurred."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fluoromap.contracts import Array
from fluoromap.segmenter.picture.log_image import Image

WINDOW_MS = 70.0
"""Longest time between the middle frame and another frame of a mean. A catheter's velocity hardly changes in it."""

_RINGS, _RING_MM = 2, 0.9


def moved_means(images: Sequence[Image], times_ms: Array, middle: int, px_per_mm: float) -> Iterator[Image]:
    """Yield the mean of the images for each velocity.

    Catheters have the places of the middle image. The velocities lie on two rings of a hexagonal grid round no motion: from ring
    to ring, the frame farthest in time is moved by 0.9 mm more.

    Parameters
    ----------
    images : sequence of (rows, columns) float32
        Log images of successive frames, two or more.
    times_ms : (images,)
    middle : int
        Index of the middle image.
    px_per_mm : float
        Of the frame, at the isocentre.
    """
    elapsed = times_ms - times_ms[middle]
    shares = elapsed / np.abs(elapsed).max()
    rows, columns = images[middle].shape
    edge = int(np.ceil(_RINGS * _RING_MM * px_per_mm))
    padded = [np.pad(x, edge, mode="edge") for x in images]
    for farthest_px in _hexagons(_RINGS) * _RING_MM * px_per_mm:
        total = np.zeros((rows, columns), np.float32)
        # Whole pixels: the rest of a pixel is small beside an electrode.
        for x, (du, dv) in zip(padded, np.rint(shares[:, None] * farthest_px).astype(np.int64) + edge, strict=True):
            total += x[dv : dv + rows, du : du + columns]
        yield total / np.float32(len(images))


def _hexagons(rings: int) -> Array:
    """Return the places of a hexagonal grid with a spacing of 1, (n, 2)."""
    steps = np.arange(-rings, rings + 1)
    a, b = (grid.ravel() for grid in np.meshgrid(steps, steps))
    places: Array = np.stack([a + 0.5 * b, np.sqrt(0.75) * b], axis=1)[np.abs(a + b) <= rings]
    return places
