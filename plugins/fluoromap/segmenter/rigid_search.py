"""Where a chain seen before stands now, if nothing but its place and direction changed: search on the blob response."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.blob_response import BlobResponse
from fluoromap.segmenter.log_image import Image

_TURNS_RAD = np.deg2rad([0.0, -4.0, 4.0, -8.0, 8.0])
_MOST_SNR = 12.0
_TAKEN_SNR = 2.0
_TAKEN_MM = 0.9
_FAR_WEIGHT = 1.2
_OUTSIDE = -5.0


def rigid_search(
    response: BlobResponse, points_uv: Array, shift: Array, reach_px: float, taken: Sequence[Chain]
) -> Array:
    """The points moved by about ``shift``, at most ``reach_px`` farther and turned by up to 8 degrees, to where the summed
    response over noise is highest; (n, 2) pixels.

    Near electrodes of chains that are ``taken`` the response counts little: a catheter does not jump onto another.
    """
    best = response.best.copy()
    offset, factor = 0.5 * (response.reduction - 1), 1.0 / response.reduction
    for chain in taken:
        _dim(best, (chain.pixels_uv - offset) * factor, _TAKEN_MM * response.px_per_mm * factor)
    middle = points_uv.mean(axis=0)
    moved = np.empty(3)
    _search(
        best,
        (points_uv - middle) * factor,
        (middle + shift - offset) * factor,
        int(reach_px * factor),
        _TURNS_RAD,
        moved,
    )
    cosine, sine = np.cos(moved[2]), np.sin(moved[2])
    turned: Array = (points_uv - middle) @ np.array([[cosine, sine], [-sine, cosine]])
    turned += middle + shift + moved[:2] * response.reduction
    return turned


def _dim(best: Image, places: Array, radius: float) -> None:
    """Lower the response within ``radius`` of the places, (n, 2), in place."""
    rows, columns = best.shape
    steps = np.arange(-math.ceil(radius), math.ceil(radius) + 2)
    middle = np.floor(places).astype(np.int64)
    u = middle[:, 0, None, None] + steps
    v = middle[:, 1, None, None] + steps[:, None]
    near = (u - places[:, 0, None, None]) ** 2 + (v - places[:, 1, None, None]) ** 2 <= radius * radius
    near = near & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    u, v = (np.broadcast_to(axis, near.shape)[near] for axis in (u, v))
    best[v, u] = np.minimum(best[v, u], np.float32(_TAKEN_SNR))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _search(best, shape, middle, reach, turns, moved):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = best.shape
    highest = -np.inf
    for turn in turns:
        cosine, sine = np.cos(turn), np.sin(turn)
        for dv in range(-reach, reach + 1):
            for du in range(-reach, reach + 1):
                square = du * du + dv * dv
                if square > reach * reach:
                    continue
                total = -_FAR_WEIGHT * square / max(reach, 1)
                for k in range(shape.shape[0]):
                    u = int(middle[0] + du + cosine * shape[k, 0] - sine * shape[k, 1] + 0.5)
                    v = int(middle[1] + dv + sine * shape[k, 0] + cosine * shape[k, 1] + 0.5)
                    if 0 <= u < columns and 0 <= v < rows:
                        total += min(best[v, u], np.float32(_MOST_SNR))
                    else:
                        total += _OUTSIDE
                if total > highest:
                    highest = total
                    moved[0], moved[1], moved[2] = du, dv, turn
