"""Text that a console burns into pictures: it is no part of the X-ray image, and its letters look like electrodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fluoromap.contracts import BoolArray, IntArray
from fluoromap.segmenter.picture.log_image import Image

_SIZE = 512
"""Lengths in pixels below are those of a picture of this size."""

_STROKE_PX, _LEAST_HEIGHT_PX, _MOST_HEIGHT_PX, _MARGIN_PX, _SAME_LINE_PX = 7, 5, 40, 3, 1
_END_OF_SCALE, _BRIGHTEST = 0.15, 8
_CONTRAST, _NOISES, _NOISE_OF_STEPS = 0.25, 3.0, 1.05
_FEW_PIXELS, _WAY_TO_END = 12, 0.4
_LEAST_LETTERS, _WIDEST, _GAP = 3, 8.0, 3.0
_FILLED, _MOST_FILLED, _LEAST_AT_END = 0.7, 0.5, 0.5
_ABOVE, _BESIDE = 0.6, 2.0


def burnt_in_text(frames: Sequence[NDArray[np.generic]]) -> BoolArray:
    """Return the rectangles of burnt-in lines of text, (rows, columns).

    Thin strokes that all frames show are letters under three conditions:

    - Three or more lie in a line: their first rows are the same up to a pixel, and so are their last rows. Electrodes lie so only
      by chance.
    - Half of them or more fill less than 70 % of their rectangles. An electrode in such a line fills its own.
    - Half of them or more reach the end of the scale, white or black.

    Parameters
    ----------
    frames : sequence of (rows, columns)
        Stored grey levels of one run.
    """
    brightest, darkest = np.minimum.reduce(frames), np.maximum.reduce(frames)
    return _bright_text(brightest.astype(np.float32)) | _bright_text(-darkest.astype(np.float32))


def _bright_text(level: Image) -> BoolArray:
    """Return the rectangles of text at the upper end of the scale."""
    text = np.zeros(level.shape, np.bool_)
    unit = max(1, round(min(level.shape) / _SIZE))
    side = unit * _STROKE_PX
    low, high = np.percentile(level[::4, ::4], [0.5, 99.5])
    noise = _NOISE_OF_STEPS * float(np.median(np.abs(np.diff(level[::4, ::2], axis=1))))
    least = max(_CONTRAST * (high - low), _NOISES * noise)
    # A single pixel may be brighter by defect.
    end = np.partition(level[::2, ::2], -_BRIGHTEST, axis=None)[-_BRIGHTEST]
    at_end = level >= end - _END_OF_SCALE * (high - low)
    if np.count_nonzero(at_end & _is_thin(level, least, side // 2 + 1)) < _FEW_PIXELS:
        return text
    ground = ndimage.maximum_filter(ndimage.minimum_filter(level, side), side)
    ground += np.median((level - ground)[::4, ::4])
    is_stroke = level - ground > np.maximum(least, _WAY_TO_END * (end - ground))
    strokes, count = ndimage.label(is_stroke, np.ones((3, 3)))
    areas = np.bincount(strokes[strokes > 0], minlength=count + 1)[1:]
    reach_end = np.bincount(strokes[at_end], minlength=count + 1)[1:] > 0
    boxes = np.array([(v.start, v.stop, u.start, u.stop) for v, u in ndimage.find_objects(strokes)], np.int64)
    margin = unit * _MARGIN_PX
    for first, last, left, right in _lines(boxes.reshape(-1, 4), areas, reach_end, unit):
        text[max(first - margin, 0) : last + margin, max(left - margin, 0) : right + margin] = True
    return text


def _is_thin(level: Image, least: float, reach: int) -> BoolArray:
    """Return which pixels are brighter than both pixels ``reach`` beside them."""
    thin = np.zeros(level.shape, np.bool_)
    beside = np.maximum(level[:, : -2 * reach], level[:, 2 * reach :])
    thin[:, reach:-reach] = level[:, reach:-reach] - beside > least
    return thin


def _lines(boxes: IntArray, areas: IntArray, reach_end: BoolArray, unit: int) -> list[tuple[int, int, int, int]]:
    """Return the rectangles of lines of text among strokes.

    Parameters
    ----------
    boxes : (n, 4)
        First row, last row + 1, first column, last column + 1 of each stroke.
    areas : (n,)
        Pixels.
    reach_end : (n,)
        Whether a stroke reaches the end of the scale.
    unit : int
        Size of the picture as a multiple of 512.
    """
    first, last, left, right = boxes.T
    height, width = last - first, right - left
    letters = np.flatnonzero(
        (height >= unit * _LEAST_HEIGHT_PX) & (height <= unit * _MOST_HEIGHT_PX) & (width <= _WIDEST * height)
    )
    if len(letters) < _LEAST_LETTERS:
        return []
    line_of = _linked(boxes, letters, unit)
    members = np.bincount(line_of)
    filled = np.bincount(line_of, weights=areas > _FILLED * height * width)
    ends = np.bincount(line_of, weights=reach_end)
    possible = (members >= _LEAST_LETTERS) & (filled <= _MOST_FILLED * members) & (ends >= _LEAST_AT_END * members)
    found = []
    for number in np.flatnonzero(possible):
        own = line_of == number
        if max(np.ptp(first[own]), np.ptp(last[own])) > 2 * unit * _SAME_LINE_PX:
            continue
        top, bottom = first[own].min(), last[own].max()
        size = bottom - top
        # Points, dashes and letters with a stem below the line have other rows.
        beside = reach_end & (first >= top - _ABOVE * size) & (last <= bottom + _ABOVE * size)
        line = np.flatnonzero(own | beside)
        line = line[np.argsort(left[line])]
        gaps = left[line][1:] - np.maximum.accumulate(right[line])[:-1]
        part = np.concatenate([[0], np.cumsum(gaps > _BESIDE * size)])
        line = line[np.isin(part, part[own[line]])]
        found.append((first[line].min(), last[line].max(), left[line].min(), right[line].max()))
    return found


def _linked(boxes: IntArray, letters: IntArray, unit: int) -> IntArray:
    """Return the number of the line of each stroke, (n,).

    Letters next to each other with the same first and last row share one.
    """
    first, last, left, right = boxes.T
    rows_px = unit * (_SAME_LINE_PX + 0.5)
    columns_px = unit * (_GAP + _WIDEST) * _MOST_HEIGHT_PX
    places = np.stack([first / rows_px, last / rows_px, 0.5 * (left + right) / columns_px], axis=1)
    one, other = letters[cKDTree(places[letters]).query_pairs(1.0, np.inf, output_type="ndarray").T]
    gaps = np.maximum(left[one], left[other]) - np.minimum(right[one], right[other])
    near = gaps <= _GAP * (last - first)[one]
    links = coo_array((np.ones(np.count_nonzero(near)), (one[near], other[near])), shape=(len(boxes), len(boxes)))
    _, line_of = connected_components(links, directed=False)
    return line_of.astype(np.int64)
