"""Crossings: a shaft, lead or cable that crosses a catheter looks like an electrode there."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.judge.features.shaft_ends import ray_depths
from fluoromap.segmenter.picture.shaft_image import ShaftImage

_ANGLES_RAD = np.deg2rad(np.linspace(40.0, 140.0, 11))
_REACH_MM = 2.0, 5.5
_CLEAR = 0.5
_BENT = 1


def are_crossings(points_uv: Array, chain_uv: Array, shaft_image: ShaftImage) -> BoolArray:
    """Return at which points a dark line crosses a chain, (n,).

    The line goes on to both sides at 40 degrees or more to the chain, and bends by at most 10 degrees there. Points farther
    from all electrodes than the chain's widest gap are none: a curved chain has another direction there.

    Parameters
    ----------
    points_uv : (n, 2)
        Pixels, on the chain or in its line.
    chain_uv : (electrodes, 2)
        Pixels from the tip on.
    shaft_image : ShaftImage
    """
    middles, gaps = 0.5 * (chain_uv[:-1] + chain_uv[1:]), np.diff(chain_uv, axis=0)
    nearest = np.linalg.norm(points_uv[:, None] - middles[None], axis=2).argmin(axis=1)
    away = np.linalg.norm(points_uv[:, None] - chain_uv[None], axis=2).min(axis=1)
    way = gaps[nearest]
    angles = np.arctan2(way[:, 1], way[:, 0])[:, None] + _ANGLES_RAD
    one, other = (ray_depths(points_uv, angles + turn, _REACH_MM, shaft_image) for turn in (0.0, np.pi))
    other = ndimage.maximum_filter1d(other, 2 * _BENT + 1, axis=1, mode="nearest")
    crossed: BoolArray = np.minimum(one, other).max(axis=1) >= _CLEAR
    crossed &= away <= np.linalg.norm(gaps, axis=1).max()
    return crossed
