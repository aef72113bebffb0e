"""Search for a chain when only its place and direction changed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.electrodes.proposals import Likeness
from fluoromap.segmenter.picture.log_image import Image

_TURNS_RAD = np.deg2rad([0.0, -4.0, 4.0, -8.0, 8.0])
_MOST = 12.0
_TAKEN = 2.0
_TAKEN_MM = 0.9
_FAR_WEIGHT = 1.2
_OUTSIDE = -5.0


def rigid_search(
    likeness: Likeness, points_uv: Array, shift: Array, reach_px: float, taken: Sequence[Chain], px_per_mm: float
) -> Array:
    """Move the points to where the summed likeness to electrodes is highest.

    The points (n, 2), pixels, move by about ``shift``, at most ``reach_px`` farther, and turn by up to 8 degrees. Near
    electrodes of the chains ``taken`` it counts little: a catheter does not jump onto another.
    """
    offset, factor = likeness.first_px, 1.0 / likeness.cell_px
    middle = points_uv.mean(axis=0)
    reach = int(reach_px * factor)
    steps = np.arange(-reach, reach + 1)
    squares = steps * steps + steps[:, None] ** 2
    price = np.where(squares <= reach * reach, _FAR_WEIGHT / max(reach, 1) * squares, np.inf).astype(np.float32)
    turns = []
    for turn in _TURNS_RAD:
        cosine, sine = math.cos(turn), math.sin(turn)
        turns.append((points_uv - middle) @ np.array([[cosine, sine], [-sine, cosine]]) + (middle + shift))
    places = np.rint((np.array(turns) - offset) * factor).astype(np.int64) - reach
    left, top = places.min(axis=(0, 1)).tolist()
    right, bottom = (places.max(axis=(0, 1)) + len(steps)).tolist()
    near = _cut_out(likeness.values, left, right, top, bottom)
    if taken:
        beside = np.concatenate([chain.pixels_uv for chain in taken])
        _dim(near, (beside - offset) * factor - [left, top], _TAKEN_MM * px_per_mm * factor)
    highest = -np.inf
    found: Array = turns[0]
    for turned, corners in zip(turns, (places - [left, top]).tolist(), strict=True):
        total = -price
        for u, v in corners:
            total += near[v : v + len(steps), u : u + len(steps)]
        place = int(total.argmax())
        if total.flat[place] > highest:
            highest = float(total.flat[place])
            row, column = divmod(place, len(steps))
            found = turned + np.array([steps[column], steps[row]]) * likeness.cell_px
    return found


def _cut_out(values: Image, left: int, right: int, top: int, bottom: int) -> Image:
    """Return the likeness in a rectangle, limited to 12, and -5 outside the image."""
    cut: Image = np.full((bottom - top, right - left), _OUTSIDE, np.float32)
    rows, columns = values.shape
    u0, u1, v0, v1 = max(left, 0), min(right, columns), max(top, 0), min(bottom, rows)
    if u0 < u1 and v0 < v1:
        cut[v0 - top : v1 - top, u0 - left : u1 - left] = np.minimum(values[v0:v1, u0:u1], np.float32(_MOST))
    return cut


def _dim(near: Image, places: Array, radius: float) -> None:
    """Lower the likeness within ``radius`` of the places, (n, 2), in place.

    One call of skimage.draw.disk for each place gives the same result in nine times the time.
    """
    rows, columns = near.shape
    steps = np.arange(-math.ceil(radius), math.ceil(radius) + 2)
    middle = np.floor(places).astype(np.int64)
    u = middle[:, 0, None, None] + steps
    v = middle[:, 1, None, None] + steps[:, None]
    within = (u - places[:, 0, None, None]) ** 2 + (v - places[:, 1, None, None]) ** 2 <= radius * radius
    within = within & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    u, v = (np.broadcast_to(axis, within.shape)[within] for axis in (u, v))
    near[v, u] = np.minimum(near[v, u], np.float32(_TAKEN))
