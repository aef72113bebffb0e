"""Which end of a chain the shaft leaves: nothing dark goes on beyond a tip.

A shaft bends, so a fan of rays is looked at beyond each end, and the darkest ray counts.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

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
    """Return the depth of the darkest ray from each end.

    A ray's depth is the mean of the darker side less the middle, in depths of a clear shaft: (n,) from -1 to 1, and 0 outside
    the image.
    """
    scale = 1.0 / shaft_image.reduction
    steps = (later_mm + np.linspace(*_REACH_MM, _SAMPLES)) * shaft_image.px_per_mm
    darkest = np.zeros(len(ends_uv))
    _measure_rays(
        shaft_image.smooth, np.ascontiguousarray(ends_uv), np.ascontiguousarray(ways), _FAN_RAD, steps, scale,
        shaft_image.side_px * scale, shaft_image.clear, darkest,
    )  # fmt: skip
    return darkest


@njit(cache=True, nogil=True, error_model="numpy")
def _measure_rays(smooth, ends_uv, ways, fan, steps, scale, side, clear, darkest):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the depth of the darkest ray from each end.

    An end without enough samples keeps its value.
    """
    last_u, last_v = smooth.shape[1] - 1, smooth.shape[0] - 1
    for end in range(ends_uv.shape[0]):
        way = math.atan2(ways[end, 1], ways[end, 0])
        best = -np.inf
        for ray in range(fan.size):
            along_u, along_v = math.cos(way + fan[ray]), math.sin(way + fan[ray])
            across_u, across_v = -along_v * side, along_u * side
            count, total = 0, 0.0
            for sample in range(steps.size):
                u = (ends_uv[end, 0] + steps[sample] * along_u + 0.5) * scale - 0.5
                v = (ends_uv[end, 1] + steps[sample] * along_v + 0.5) * scale - 0.5
                wide_u, wide_v = abs(across_u), abs(across_v)
                if not (u - wide_u >= 0 and v - wide_v >= 0 and u + wide_u <= last_u and v + wide_v <= last_v):
                    continue
                left = smooth[int(v - across_v + 0.5), int(u - across_u + 0.5)]
                middle = smooth[int(v + 0.5), int(u + 0.5)]
                right = smooth[int(v + across_v + 0.5), int(u + across_u + 0.5)]
                depth = (min(left, right) - middle) / clear
                total += min(max(depth, -1.0), _DARKEST)
                count += 1
            if count >= _LEAST_SAMPLES:
                best = max(best, min(max(total / count, -1.0), 1.0))
        if best > -np.inf:
            darkest[end] = best
