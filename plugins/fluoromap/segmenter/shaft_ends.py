"""Which end of a chain the shaft leaves: nothing dark goes on beyond a tip.

A shaft bends, so a fan of rays is looked at beyond each end, and the darkest ray counts.
"""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array
from fluoromap.segmenter.linking import ShaftImage

_FAN_RAD = np.deg2rad(np.linspace(-25.0, 25.0, 9))
_REACH_MM = 2.4, 8.0
_SAMPLES = 12
_LEAST_SAMPLES = 3
_HALF_RING_MM = 0.5
_DARKEST = 1.5


def shaft_beyond_ends(chains_uv: Array, tip_mm: float, shaft_image: ShaftImage) -> Array:
    """Return how much more a shaft shows behind than before chains.

    The result (n,) lies between -2 and 2.

    Parameters
    ----------
    chains_uv : (n, electrodes, 2)
        Pixels from the tip on.
    tip_mm : float
        Length of the tip electrode.
    shaft_image : ShaftImage
    """
    behind = _darkest_ray(chains_uv[:, -1], chains_uv[:, -1] - chains_uv[:, -2], 0.0, shaft_image)
    before = _darkest_ray(chains_uv[:, 0], chains_uv[:, 0] - chains_uv[:, 1], 0.5 * tip_mm - _HALF_RING_MM, shaft_image)
    more: Array = behind - before
    return more


def _darkest_ray(ends_uv: Array, ways: Array, later_mm: float, shaft_image: ShaftImage) -> Array:
    """Return the depth of the darkest ray from each end, (n,).

    It lies between -1 and 1, and is 0 outside the image.
    """
    angles = np.arctan2(ways[:, 1], ways[:, 0])[:, None] + _FAN_RAD
    first, last = _REACH_MM
    darkest = ray_depths(ends_uv, angles, (later_mm + first, later_mm + last), shaft_image).max(axis=-1)
    return np.where(np.isfinite(darkest), darkest, 0.0)


def ray_depths(starts_uv: Array, angles_rad: Array, reach_mm: tuple[float, float], shaft_image: ShaftImage) -> Array:
    """Return the depth of rays from points, (n, rays).

    A ray's depth is the mean of the darker side less the middle, in depths of a clear shaft: from -1 to 1, and -inf outside the
    image.

    Parameters
    ----------
    starts_uv : (n, 2)
        Pixels.
    angles_rad : (n, rays)
        Directions, from the column axis to the row axis.
    reach_mm : tuple of float
        Where the rays begin and end, from their points.
    shaft_image : ShaftImage
    """
    smooth, scale = shaft_image.smooth, 1.0 / shaft_image.reduction
    along = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)[:, :, None]
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1) * (shaft_image.side_px * scale)
    steps = np.linspace(*reach_mm, _SAMPLES)[:, None] * shaft_image.px_per_mm
    middle = (starts_uv[:, None, None] + steps * along + 0.5) * scale - 0.5
    last = np.array(smooth.shape[::-1]) - 1
    inside = ((middle - np.abs(across) >= 0) & (middle + np.abs(across) <= last)).all(axis=-1)
    values = [smooth[cell[..., 1], cell[..., 0]] for cell in (
        np.clip(np.rint(middle + side * across), 0, last).astype(np.int64) for side in (-1.0, 0.0, 1.0)
    )]  # fmt: skip
    depth = np.clip((np.minimum(values[0], values[2]) - values[1]) / shaft_image.clear, -1.0, _DARKEST)
    count = inside.sum(axis=-1)
    mean = np.where(inside, depth, 0.0).sum(axis=-1) / np.maximum(count, 1)
    depths: Array = np.where(count >= _LEAST_SAMPLES, np.clip(mean, -1.0, 1.0), -np.inf)
    return depths
