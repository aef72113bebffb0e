"""Rows of parallel bars, as the ribs of an echo probe's bending section: their ends or middles look like electrodes."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from fluoromap.contracts import Array
from fluoromap.segmenter.linking import ShaftImage

_STEP_MM, _BEYOND_MM, _AHEAD_MM, _ANATOMY_MM = 0.25, 2.0, 2.0, 6.0
BESIDE_MM, ACROSS_MM = np.linspace(2.0, 4.5, 6), np.linspace(5.0, 9.0, 9)
"""Distances of lines from a chain: those on the bars, and those that may lie on the other wall of a probe."""
_LEAST_CORRELATION, _LEAST_SHARE, _LEAST_SHARE_ACROSS = 0.45, 0.3, 0.35
_TINY = 1e-12


def products_beside(chain_uv: Array, shaft_image: ShaftImage, beside_mm: Array = BESIDE_MM) -> Array:
    """Compare the picture along a chain with the picture beside it.

    Parameters
    ----------
    chain_uv : (electrodes, 2)
        Pixels.
    shaft_image : ShaftImage
    beside_mm : (lines,)
        Distances of the lines to the left and to the right.

    Returns
    -------
    (2, lines, electrodes, 3)
        Of the lines to the left and to the right, around each electrode: sum of products with the chain's own line, sum of
        the own line's squares, sum of the line's squares. Only differences over 6 mm count: anatomy changes more slowly. The
        products of several pictures add.
    """
    px_per_mm = shaft_image.px_per_mm
    ways = np.diff(chain_uv, axis=0)
    lengths = np.maximum(np.linalg.norm(ways, axis=1), _TINY)
    reach = _BEYOND_MM + 0.5 * _ANATOMY_MM + _AHEAD_MM
    first, last = (
        reach * px_per_mm * way / length for way, length in zip(ways[[0, -1]], lengths[[0, -1]], strict=True)
    )
    corners = np.concatenate([chain_uv[:1] - first, chain_uv, chain_uv[-1:] + last])
    places_mm = np.concatenate([[0.0], np.cumsum(lengths)]) / px_per_mm
    corners_mm = np.concatenate([[-reach], places_mm, [places_mm[-1] + reach]])
    margin = round(0.5 * _ANATOMY_MM / _STEP_MM)
    count = math.ceil((places_mm[-1] + 2 * _BEYOND_MM) / _STEP_MM) + 1
    at_mm = _STEP_MM * np.arange(-margin, count + margin) - _BEYOND_MM
    ways_mm = np.stack([at_mm, at_mm + _AHEAD_MM, at_mm - _AHEAD_MM])
    line, after, before = np.stack([np.interp(ways_mm, corners_mm, axis) for axis in corners.T], axis=-1)
    ahead = after - before
    ahead *= px_per_mm / np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), _TINY)
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    offsets_mm = np.concatenate([[0.0], beside_mm, -beside_mm])
    depths = _values(line + offsets_mm[:, None, None] * across, shaft_image)
    depths -= ndimage.uniform_filter1d(depths, 2 * margin + 1, axis=1)
    depths, at_mm = depths[:, margin:-margin], at_mm[margin:-margin]
    own, beside = depths[:1], depths[1:]
    squares = np.stack([beside * own, np.broadcast_to(own * own, beside.shape), beside * beside], axis=-1)
    is_nearest = np.abs(at_mm[:, None] - places_mm).argmin(axis=1)[:, None] == np.arange(len(places_mm))
    products: Array = np.einsum("lnp,ne->lep", squares, is_nearest)
    return products.reshape(2, len(beside_mm), len(places_mm), 3)


def follows_bars(products: Array) -> bool:
    """Return whether a chain's electrodes are places on parallel bars.

    A ring ends 1.2 mm beside the middle of its catheter. Bars go on, and so do the gaps between them: on one side of the chain all
    lines follow the line along it, with 0.3 of its contrast or more. They do so without any one of the electrodes too: a cable
    that crosses the chain is beside one of them. A shaft along the chain has no gaps.

    Parameters
    ----------
    products : (2, lines, electrodes, 3)
        See :func:`products_beside`.
    """
    correlation, share = _without_each(products)
    follows = (correlation.min(axis=1) >= _LEAST_CORRELATION) & (share.mean(axis=1) >= _LEAST_SHARE)
    return bool(follows.all(axis=1).any())


def has_other_wall(products: Array) -> bool:
    """Return whether a chain's electrodes are the ends of a tube's bars.

    Often only the walls of the tube are dark enough to show its bars. A line at the other wall follows the line along the chain,
    with 0.35 of its contrast or more. Another catheter rarely has electrodes beside each of the chain's.

    Parameters
    ----------
    products : (2, lines, electrodes, 3)
        See :func:`products_beside`, for :data:`ACROSS_MM`.
    """
    correlation, share = _without_each(products)
    return bool(((correlation >= _LEAST_CORRELATION) & (share >= _LEAST_SHARE_ACROSS)).all(axis=2).any())


def _without_each(products: Array) -> tuple[Array, Array]:
    """Return correlations and shares of contrast without each of the electrodes, (2, lines, electrodes)."""
    shared, own, beside = np.moveaxis(products.sum(axis=2, keepdims=True) - products, -1, 0)
    return shared / np.sqrt(np.maximum(own * beside, _TINY)), shared / np.maximum(own, _TINY)


def _values(points_uv: Array, shaft_image: ShaftImage) -> Array:
    """Return the smooth image at points (..., 2), pixels of the frame."""
    u, v = np.moveaxis((points_uv + 0.5) / shaft_image.reduction - 0.5, -1, 0)
    values: Array = ndimage.map_coordinates(shaft_image.smooth, [v, u], np.float64, order=1, mode="nearest")
    return values
