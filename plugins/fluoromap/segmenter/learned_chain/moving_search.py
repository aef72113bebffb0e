"""Search for catheters that noise hides in every frame: means of many frames, each moved along a velocity.

A catheter moves at a nearly constant velocity for a tenth of a second. The mean of these frames, moved back by it, shows the
catheter without most of the noise, while anatomy and cables that do not move are blurred.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.chain_detector import ChainDetector
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.proposals import log_odds

WINDOW_MS = 70.0
"""Longest time between the middle frame and another frame of the mean."""

_RINGS, _RING_MM = 2, 0.9
"""Velocities: rings of a hexagonal grid round no motion. From ring to ring the outermost frame is moved by this much more."""
_SAME_MM = 1.2
_LEAST_ODDS = 0.0


def moving_chains(detector: ChainDetector, images: Sequence[Image], times_ms: Array, middle: int, frame: int) -> tuple[Chain, ...]:
    """Return the chains of moved means, at their place in the middle image, most probable first.

    Parameters
    ----------
    detector : ChainDetector
    images : sequence of (rows, columns) float32
        Log images of successive frames.
    times_ms : (images,)
    middle : int
        Index of the image in which catheters are searched.
    frame : int
        Its number in the run.
    """
    found: list[tuple[float, Chain]] = []
    for x in moved_means(images, times_ms, middle, detector.px_per_mm):
        detector.forget_image()
        chains = detector.find_chains(x, frame).chains
        seen = detector.image_evidence(x)
        found += [(float(np.median(log_odds(seen.probability_at(chain.pixels_uv)))), chain) for chain in chains]
    detector.forget_image()
    best: list[Chain] = []
    for odds, chain in sorted(found, key=lambda one: -one[0]):
        if odds >= _LEAST_ODDS and all(_apart(chain, other, _SAME_MM * detector.px_per_mm) for other in best):
            best.append(chain)
    return tuple(best)


def moved_means(images: Sequence[Image], times_ms: Array, middle: int, px_per_mm: float) -> Iterator[Image]:
    """Yield the mean of the images for each velocity, moved to the place of the middle one."""
    elapsed = times_ms - times_ms[middle]
    shares = elapsed / np.abs(elapsed).max()
    farthest = _RINGS * _RING_MM * px_per_mm
    edge = int(np.ceil(farthest))
    padded = [np.pad(x, edge, mode="edge") for x in images]
    rows, columns = images[middle].shape
    for moved_px in _hexagons(_RINGS) * _RING_MM * px_per_mm:
        total = np.zeros((rows, columns), np.float32)
        for x, (du, dv) in zip(padded, np.rint(shares[:, None] * moved_px).astype(np.int64) + edge, strict=True):
            total += x[dv : dv + rows, du : du + columns]
        yield total / np.float32(len(images))


def _hexagons(rings: int) -> Array:
    """Return the places of a hexagonal grid with a spacing of 1, from its middle outwards, (n, 2)."""
    steps = np.arange(-rings, rings + 1)
    a, b = (grid.ravel() for grid in np.meshgrid(steps, steps))
    inside = np.abs(a + b) <= rings
    places = np.stack([a + 0.5 * b, np.sqrt(0.75) * b], axis=1)[inside]
    ordered: Array = places[np.argsort(np.linalg.norm(places, axis=1).round(6), kind="stable")]
    return ordered


def _apart(one: Chain, other: Chain, near_px: float) -> bool:
    """Return whether fewer than two electrodes of a chain lie on another chain."""
    away = np.linalg.norm(one.pixels_uv[:, None] - other.pixels_uv[None], axis=2).min(axis=1)
    return int(np.count_nonzero(away < near_px)) < 2
