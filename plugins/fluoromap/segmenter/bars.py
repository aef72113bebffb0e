"""Rows of parallel bars, as the ribs of an echo probe's bending section: their ends or middles look like electrodes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fluoromap.contracts import Array
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
    ways = chain_uv[1:] - chain_uv[:-1]
    lengths = np.maximum(np.sqrt((ways * ways).sum(axis=1)), _TINY)
    first, last = (_AROUND_MM * px_per_mm / lengths[end] * ways[end] for end in (0, -1))
    corners_uv = np.concatenate([chain_uv[:1] - first, chain_uv, chain_uv[-1:] + last])
    corners_mm = np.cumsum(np.concatenate([[-_AROUND_MM, _AROUND_MM], lengths / px_per_mm, [_AROUND_MM]]))
    lines_followed = np.zeros((len(chain_uv), 2, len(_BESIDE_MM)), np.bool_)
    _compare_lines(
        shaft_image.smooth, 1.0 / shaft_image.reduction, px_per_mm, corners_uv, corners_mm, _WINDOW_MM, _RAMP, _OFFSETS_MM,
        np.empty((5, len(_WINDOW_MM))), lines_followed.reshape(len(chain_uv), -1),
    )  # fmt: skip
    on_bars = np.count_nonzero(lines_followed.all(axis=2), axis=0)
    return bool(on_bars.max() >= (1.0 - _MAY_LACK) * len(chain_uv))


@njit(cache=True, nogil=True, error_model="numpy")
def _compare_lines(smooth, scale, px_per_mm, corners_uv, corners_mm, window_mm, ramp, offsets_mm, scratch, follows):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write which lines beside each electrode follow the line along the chain.

    The chain is the line through the corners; all corners but the first and the last are electrodes. Lines are compared without
    their mean and their trend: anatomy darkens the picture evenly along all of them.

    ramp : the trend, of norm 1. offsets_mm : how far beside the chain the lines are; the first is the chain's own. scratch : for
    each place of the window its pixel, the way across the chain for 1 mm, and the picture on the chain without mean and trend.
    """
    last_u, last_v = smooth.shape[1] - 1.0, smooth.shape[0] - 1.0
    size = window_mm.size
    for electrode in range(corners_mm.size - 2):
        for i in range(size):
            ahead_u = ahead_v = 0.0
            for end in range(-1, 2):
                mm = corners_mm[electrode + 1] + window_mm[i] + end * _AROUND_MM
                before = 0
                while before < corners_mm.size - 2 and corners_mm[before + 1] < mm:
                    before += 1
                length = max(corners_mm[before + 1] - corners_mm[before], _TINY)
                share = min(max((mm - corners_mm[before]) / length, 0.0), 1.0)
                u = corners_uv[before, 0] + share * (corners_uv[before + 1, 0] - corners_uv[before, 0])
                v = corners_uv[before, 1] + share * (corners_uv[before + 1, 1] - corners_uv[before, 1])
                ahead_u += end * u
                ahead_v += end * v
                if end == 0:
                    scratch[0, i], scratch[1, i] = u, v
            stretch = px_per_mm / max(math.sqrt(ahead_u * ahead_u + ahead_v * ahead_v), _TINY)
            scratch[2, i], scratch[3, i] = -stretch * ahead_v, stretch * ahead_u
        strength = 0.0
        for line in range(offsets_mm.size):
            total = slope = square = shared = 0.0
            for i in range(size):
                u = min(max((scratch[0, i] + offsets_mm[line] * scratch[2, i] + 0.5) * scale - 0.5, 0.0), last_u)
                v = min(max((scratch[1, i] + offsets_mm[line] * scratch[3, i] + 0.5) * scale - 0.5, 0.0), last_v)
                left, top = int(u), int(v)
                right, below = min(left + 1, smooth.shape[1] - 1), min(top + 1, smooth.shape[0] - 1)
                upper = smooth[top, left] + (u - left) * (smooth[top, right] - smooth[top, left])
                lower = smooth[below, left] + (u - left) * (smooth[below, right] - smooth[below, left])
                value = upper + (v - top) * (lower - upper)
                if line == 0:
                    scratch[4, i] = value
                total += value
                slope += value * ramp[i]
                square += value * value
                shared += value * scratch[4, i]
            square = max(square - total * total / size - slope * slope, 0.0)
            if line == 0:
                strength = square
                for i in range(size):
                    scratch[4, i] -= total / size + slope * ramp[i]
            else:
                least = max(_LEAST_SLOPE * strength, _LEAST_CORRELATION * math.sqrt(strength * square))
                follows[electrode, line - 1] = shared > max(least, _TINY)
