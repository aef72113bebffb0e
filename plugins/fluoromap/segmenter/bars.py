"""Rows of parallel bars, as the ribs of an echo probe's bending section: their ends or middles look like electrodes."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.linking import ShaftImage

_AROUND_MM = 2.0
_WINDOW_MM = np.linspace(-_AROUND_MM, _AROUND_MM, 17)
_RAMP = _WINDOW_MM / np.linalg.norm(_WINDOW_MM)
_BESIDE_MM = np.linspace(2.0, 4.0, 5)
_OFFSETS_MM = np.concatenate([[0.0], _BESIDE_MM, -_BESIDE_MM])
_LEAST_SLOPE, _LEAST_CORRELATION = 0.15, 0.7
_MAY_LACK = 0.25
_TINY = 1e-12


def follows_bars(chain_uv: Array, shaft_image: ShaftImage) -> bool:
    """Return whether a chain's electrodes are places on parallel bars.

    A ring ends 1.2 mm beside the middle of its catheter. Bars go on, and so do the gaps between them: 2 to 4 mm beside three
    quarters of the electrodes, on one side of the chain, the image follows the image along the chain. Its contrast may be as
    little as 0.15 of that on the chain: the bars are of tubes, whose walls are darkest. A cable that crosses the chain is beside
    one or two electrodes, a shaft along it has no gaps.

    Parameters
    ----------
    chain_uv : (electrodes, 2)
        Pixels, those in the field.
    shaft_image : ShaftImage
    """
    px_per_mm = shaft_image.px_per_mm
    ways = np.diff(chain_uv, axis=0)
    lengths = np.maximum(np.linalg.norm(ways, axis=1), _TINY)
    first, last = (
        _AROUND_MM * px_per_mm * way / length for way, length in zip(ways[[0, -1]], lengths[[0, -1]], strict=True)
    )
    corners = np.concatenate([chain_uv[:1] - first, chain_uv, chain_uv[-1:] + last])
    places_mm = np.concatenate([[0.0], np.cumsum(lengths)]) / px_per_mm
    corners_mm = np.concatenate([[-_AROUND_MM], places_mm, [places_mm[-1] + _AROUND_MM]])
    at_mm = places_mm[:, None] + _WINDOW_MM
    ways_mm = np.stack([at_mm, at_mm + _AROUND_MM, at_mm - _AROUND_MM])
    line, after, before = np.stack([np.interp(ways_mm, corners_mm, axis) for axis in corners.T], axis=-1)
    ahead = after - before
    ahead *= px_per_mm / np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), _TINY)
    across = np.stack([-ahead[..., 1], ahead[..., 0]], axis=-1)
    depths = _values(line + _OFFSETS_MM[:, None, None, None] * across, shaft_image)
    on_bars = _follow(depths).reshape(2, len(_BESIDE_MM), -1).all(axis=1)
    return bool(on_bars.mean(axis=1).max() >= 1.0 - _MAY_LACK)


def _values(points_uv: Array, shaft_image: ShaftImage) -> Array:
    """Return the smooth image at points (..., 2), pixels of the frame."""
    u, v = np.moveaxis((points_uv + 0.5) / shaft_image.reduction - 0.5, -1, 0)
    values: Array = ndimage.map_coordinates(shaft_image.smooth, [v, u], np.float64, order=1, mode="nearest")
    return values


def _follow(depths: Array) -> BoolArray:
    """Return which lines beside each electrode follow the chain's line, (2 k, electrodes).

    depths : (1 + 2 k, electrodes, n), the chain's line and k lines on each side.
    """
    level = depths - depths.mean(axis=-1, keepdims=True)
    # Anatomy darkens the picture evenly along all lines.
    own, *beside = level - (level @ _RAMP)[..., None] * _RAMP
    shared, size = np.einsum("len,en->le", beside, own), np.linalg.norm(beside, axis=-1)
    least = np.maximum(
        _LEAST_SLOPE * np.einsum("en,en->e", own, own), _LEAST_CORRELATION * size * np.linalg.norm(own, axis=-1)
    )
    follows: BoolArray = shared > least
    return follows
