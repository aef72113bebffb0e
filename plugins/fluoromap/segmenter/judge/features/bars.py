"""Rows of parallel bars, as the ribs of an echo probe's bending section: their ends or middles look like electrodes."""

from __future__ import annotations

import math

import numpy as np

from fluoromap.contracts import Array
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.shaft_image import ShaftImage

_STEP_MM, _BEYOND_MM, _AHEAD_MM = 0.25, 2.0, 2.0
_MARGIN = 12
"""Samples before and after each other one whose mean is anatomy: together 6 mm."""
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
    ways = chain_uv[1:] - chain_uv[:-1]
    lengths = np.maximum(np.sqrt((ways * ways).sum(axis=1)), _TINY)
    reach = _BEYOND_MM + _MARGIN * _STEP_MM + _AHEAD_MM
    first, last = (reach * px_per_mm / lengths[end] * ways[end] for end in (0, -1))
    corners_uv = np.concatenate([chain_uv[:1] - first, chain_uv, chain_uv[-1:] + last])
    corners_mm = np.cumsum(np.concatenate([[-reach, reach], lengths / px_per_mm, [reach]]))
    samples = math.ceil((corners_mm[-2] + 2 * _BEYOND_MM) / _STEP_MM) + 1 + 2 * _MARGIN
    offsets_mm = np.concatenate([[0.0], beside_mm, -beside_mm])
    products: Array = np.zeros((2, len(beside_mm), len(chain_uv), 3))
    _add_products(
        shaft_image.smooth, 1.0 / shaft_image.reduction, px_per_mm, corners_uv, corners_mm, offsets_mm,
        np.empty((len(offsets_mm), samples)), np.zeros(samples), products.reshape(-1, len(chain_uv), 3),
    )  # fmt: skip
    return products


@kernel("f4[:,::1], f8, f8, f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8[:,:,::1]", fastmath=False)
def _add_products(smooth, scale, px_per_mm, corners_uv, corners_mm, offsets_mm, depths, own, products):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the products of :func:`products_beside`, (lines, electrodes, 3).

    The chain is the line through the corners; all corners but the first and the last are electrodes. offsets_mm : how far beside
    the chain the lines are; the first is the chain's own. depths : (lines + 1, samples) the picture along the lines; own :
    (samples,) that of the first line less anatomy. Both are overwritten.
    """
    last_u, last_v = smooth.shape[1] - 1.0, smooth.shape[0] - 1.0
    lines, samples = depths.shape
    for i in range(samples):
        u = v = ahead_u = ahead_v = 0.0
        for end in range(-1, 2):
            mm = (i - _MARGIN) * _STEP_MM - _BEYOND_MM + end * _AHEAD_MM
            corner = 0
            while corner < corners_mm.size - 2 and corners_mm[corner + 1] < mm:
                corner += 1
            share = (mm - corners_mm[corner]) / max(corners_mm[corner + 1] - corners_mm[corner], _TINY)
            share = min(max(share, 0.0), 1.0)
            at_u = corners_uv[corner, 0] + share * (corners_uv[corner + 1, 0] - corners_uv[corner, 0])
            at_v = corners_uv[corner, 1] + share * (corners_uv[corner + 1, 1] - corners_uv[corner, 1])
            ahead_u += end * at_u
            ahead_v += end * at_v
            if end == 0:
                u, v = at_u, at_v
        stretch = px_per_mm / max(math.sqrt(ahead_u * ahead_u + ahead_v * ahead_v), _TINY)
        for line in range(lines):
            across = stretch * offsets_mm[line]
            x = min(max((u - across * ahead_v + 0.5) * scale - 0.5, 0.0), last_u)
            y = min(max((v + across * ahead_u + 0.5) * scale - 0.5, 0.0), last_v)
            left, top = int(x), int(y)
            right, below = min(left + 1, smooth.shape[1] - 1), min(top + 1, smooth.shape[0] - 1)
            upper = smooth[top, left] + (x - left) * (smooth[top, right] - smooth[top, left])
            lower = smooth[below, left] + (x - left) * (smooth[below, right] - smooth[below, left])
            depths[line, i] = upper + (y - top) * (lower - upper)
    window = 2 * _MARGIN + 1
    for line in range(lines):
        electrode, anatomy = 0, 0.0
        for i in range(window - 1):
            anatomy += depths[line, i]
        for i in range(_MARGIN, samples - _MARGIN):
            anatomy += depths[line, i + _MARGIN]
            depth = depths[line, i] - anatomy / window
            anatomy -= depths[line, i - _MARGIN]
            if line == 0:
                own[i] = depth
                continue
            mm = (i - _MARGIN) * _STEP_MM - _BEYOND_MM
            while electrode < corners_mm.size - 3 and corners_mm[electrode + 2] - mm < mm - corners_mm[electrode + 1]:
                electrode += 1
            products[line - 1, electrode, 0] += depth * own[i]
            products[line - 1, electrode, 1] += own[i] * own[i]
            products[line - 1, electrode, 2] += depth * depth


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
