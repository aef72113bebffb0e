"""Which end of a chain the shaft leaves: nothing dark goes on beyond a tip.

A shaft bends, so a fan of rays is looked at beyond each end, and the darkest ray counts. A loop's shaft may leave it in a wide
fan; rays that meet the loop itself do not count.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.shaft_image import ShaftImage

_FAN_RAD, _LOOP_FAN_RAD = np.deg2rad(np.linspace(-25.0, 25.0, 9)), np.deg2rad(np.linspace(-45.0, 45.0, 15))
_NARROW_FAN_RAD, _NEAR_REACH_MM = np.deg2rad(np.linspace(-15.0, 15.0, 7)), (2.4, 5.0)
_BESIDE_LOOP_MM = 1.5
_REACH_MM = 2.4, 8.0
_SAMPLES = 12
_LEAST_SAMPLES = 3
_HALF_RING_MM = 0.5
_DARKEST = 1.5


def shaft_beyond_ends(chains_uv: Array, catheter: Catheter, shaft_image: ShaftImage) -> Array:
    """Return how much more a shaft shows behind than before chains.

    The result (n,) lies between -2 and 2.

    Parameters
    ----------
    chains_uv : (n, electrodes, 2)
        Pixels from the tip on.
    catheter : Catheter
    shaft_image : ShaftImage
    """
    from_tip = chains_uv[:, ::-1]
    behind = _darkest_ray(chains_uv, 0.0, catheter.is_circular, shaft_image)
    before = _darkest_ray(from_tip, 0.5 * catheter.tip_mm - _HALF_RING_MM, catheter.is_circular, shaft_image)
    more: Array = behind - before
    return more


def shafts_at_ends(path_uv: Array, shaft_image: ShaftImage) -> Array:
    """Return how much a shaft shows beyond both ends of a path.

    The result (2,) lies between -1 and 1, and is 0 outside the image. The image has little noise, so that the shaft's direction is
    known better than in a single frame.
    """
    ends_uv, before_uv = path_uv[[0, -1]], path_uv[[1, -2]]
    ways = ends_uv - before_uv
    angles = np.arctan2(ways[:, 1], ways[:, 0])[:, None] + _NARROW_FAN_RAD
    darkest = ray_depths(ends_uv, angles, _NEAR_REACH_MM, shaft_image).max(axis=-1)
    return np.where(np.isfinite(darkest), darkest, 0.0)


def _darkest_ray(chains_uv: Array, later_mm: float, is_circular: bool, shaft_image: ShaftImage) -> Array:
    """Return the depth of the darkest ray beyond the last place of each chain, (n,).

    It lies between -1 and 1, and is 0 outside the image.
    """
    ends_uv, ways = chains_uv[:, -1], chains_uv[:, -1] - chains_uv[:, -2]
    angles = np.arctan2(ways[:, 1], ways[:, 0])[:, None] + (_LOOP_FAN_RAD if is_circular else _FAN_RAD)
    first, last = _REACH_MM
    reach_mm = later_mm + first, later_mm + last
    depths = ray_depths(ends_uv, angles, reach_mm, shaft_image)
    if is_circular:
        depths[_meets_chain(chains_uv, angles, reach_mm, shaft_image.px_per_mm)] = -np.inf
    darkest = depths.max(axis=-1)
    return np.where(np.isfinite(darkest), darkest, 0.0)


def _meets_chain(chains_uv: Array, angles_rad: Array, reach_mm: tuple[float, float], px_per_mm: float) -> BoolArray:
    """Return which rays from the last places meet the rest of their own chain, (n, rays)."""
    rest = np.concatenate([chains_uv[:, :-2], 0.5 * (chains_uv[:, :-2] + chains_uv[:, 1:-1])], axis=1)
    ways = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
    places = chains_uv[:, None, None, -1] + _steps(reach_mm, px_per_mm)[:, None] * ways[:, :, None]
    apart = np.linalg.norm(places[..., None, :] - rest[:, None, None], axis=-1)
    meets: BoolArray = (apart < _BESIDE_LOOP_MM * px_per_mm).any(axis=(2, 3))
    return meets


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
    scale = 1.0 / shaft_image.reduction
    steps = _steps(reach_mm, shaft_image.px_per_mm)
    depths: Array = np.full(angles_rad.shape, -np.inf)
    # Copies: kernels are compiled for one kind of array only.
    _measure_rays(
        shaft_image.smooth, np.array(starts_uv, order="C"), np.array(angles_rad, order="C"), steps, scale,
        shaft_image.side_px * scale, shaft_image.clear, depths,
    )  # fmt: skip
    return depths


@functools.lru_cache(maxsize=64)
def _steps(reach_mm: tuple[float, float], px_per_mm: float) -> Array:
    """Return the distances of a ray's samples from its point, pixels."""
    return np.linspace(*reach_mm, _SAMPLES) * px_per_mm


@kernel("f4[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8, f8, f8, f8[:,::1]", fastmath=False)
def _measure_rays(smooth, starts_uv, angles_rad, steps, scale, side, clear, depths):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the depths of the rays that have enough samples in the image."""
    last_u, last_v = smooth.shape[1] - 1, smooth.shape[0] - 1
    for start in range(depths.shape[0]):
        for ray in range(depths.shape[1]):
            along_u, along_v = math.cos(angles_rad[start, ray]), math.sin(angles_rad[start, ray])
            across_u, across_v = -along_v * side, along_u * side
            wide_u, wide_v = abs(across_u), abs(across_v)
            count, total = 0, 0.0
            for sample in range(steps.size):
                u = (starts_uv[start, 0] + steps[sample] * along_u + 0.5) * scale - 0.5
                v = (starts_uv[start, 1] + steps[sample] * along_v + 0.5) * scale - 0.5
                if not (u - wide_u >= 0 and v - wide_v >= 0 and u + wide_u <= last_u and v + wide_v <= last_v):
                    continue
                left = smooth[int(v - across_v + 0.5), int(u - across_u + 0.5)]
                middle = smooth[int(v + 0.5), int(u + 0.5)]
                right = smooth[int(v + across_v + 0.5), int(u + across_u + 0.5)]
                depth = (min(left, right) - middle) / clear
                total += min(max(depth, -1.0), _DARKEST)
                count += 1
            if count >= _LEAST_SAMPLES:
                depths[start, ray] = min(max(total / count, -1.0), 1.0)
