"""The exposed part of a run's images, found once a run; nothing outside it is ever an electrode."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from fluoromap.contracts import BoolArray, FrameSource, IntArray, PixelFacts, Shutter
from fluoromap.segmenter.homomorphic import reduce_by
from fluoromap.segmenter.log_image import Image

MARGIN_PX = 16
"""Nothing closer to the edge of the field is a candidate."""

_SAMPLES = 15
_DARK = 0.06
_ERODE_PX = 10
_SIDES = 4


@dataclass(frozen=True, eq=False)
class FieldMask:
    """inside : the field, eroded. candidates : where electrodes may lie, (rows, columns) both.

    outside, nearest : flat indices of the pixels outside and, for each, of the nearest pixel inside.
    mean_level : mean stored grey level inside, over the sampled frames.
    """

    inside: BoolArray
    candidates: BoolArray
    outside: IntArray
    nearest: IntArray
    mean_level: float

    def fill(self, x: Image) -> Image:
        """Write the nearest inside value over all that lies outside, in place: no filter shall see the collimator."""
        if self.outside.size:
            flat = x.reshape(-1)
            flat[self.outside] = flat[self.nearest]
        return x


def find_field(frames: FrameSource, facts: PixelFacts) -> FieldMask:
    """Field mask of a run.

    What shutter attributes tell is believed. Else the median of at most 15 evenly spaced frames, at half size, is cut at
    6 % of its bright level, and at straight and circular collimator edges fitted to it: a grey level alone either keeps the
    penumbra of the collimator or cuts truly dark halves of the patient. The result is eroded by 10 px.
    """
    rows, columns = frames.shape
    median = _median_of_samples(frames, facts)
    if facts.shutter is not None:
        field = inside_shutter(facts.shutter, (rows, columns))
    else:
        half = bright_region(median)
        half &= _within_straight_edges(median, half)
        half &= _within_circle(median, half)
        field = np.repeat(np.repeat(half, 2, axis=0), 2, axis=1)[:rows, :columns]
    field = _largest_part(field)
    if np.count_nonzero(field) < 0.02 * field.size:
        field = np.ones((rows, columns), dtype=np.bool_)
    return _mask(field, median)


def evenly_spaced(count: int) -> list[int]:
    """At most 15 frames spread over a run of ``count``."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, _SAMPLES)).tolist()})


def inside_shutter(shutter: Shutter, shape: tuple[int, int]) -> BoolArray:
    """Pixels inside all shapes of the shutter (DICOM PS3.3 C.8.7.3: ShutterShape, and the collimator's alike)."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    inside = np.ones(shape, dtype=np.bool_)
    if shutter.rectangle is not None:
        left, right, upper, lower = shutter.rectangle
        inside &= (u > left) & (u < right) & (v > upper) & (v < lower)
    if shutter.circle is not None:
        centre_u, centre_v, radius = shutter.circle
        inside &= (u - centre_u) ** 2 + (v - centre_v) ** 2 < radius**2
    if shutter.polygon is not None and len(shutter.polygon) >= 3:
        corners = np.asarray(shutter.polygon, dtype=np.float64)
        crossings = np.zeros(shape, dtype=np.bool_)
        for (u0, v0), (u1, v1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if v0 != v1:
                at = u0 + (v - v0) * (u1 - u0) / (v1 - v0)
                crossings ^= ((v0 <= v) != (v1 <= v)) & (u < at)
        inside &= crossings
    return inside


def bright_region(median: Image) -> BoolArray:
    """Pixels above 6 % of the bright level, the largest connected part, holes filled."""
    smooth = ndimage.median_filter(median, 3)
    return _largest_part(smooth > _DARK * np.percentile(smooth, 95))


def _median_of_samples(frames: FrameSource, facts: PixelFacts) -> Image:
    stack = np.stack([reduce_by(frames[index].astype(np.float32), 2) for index in evenly_spaced(len(frames))])
    median: Image = np.median(stack, axis=0).astype(np.float32)
    return np.float32(2**facts.bits_stored - 1) - median if facts.monochrome1 else median


def _largest_part(field: BoolArray) -> BoolArray:
    labels, count = ndimage.label(field)
    if count > 1:
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        field = labels == int(np.argmax(sizes))
    filled: BoolArray = ndimage.binary_fill_holes(field)
    return filled


def _mask(field: BoolArray, median: Image) -> FieldMask:
    inside = field
    if not field.all():  # a transform without any background has no meaning
        eroded = ndimage.distance_transform_edt(np.pad(field, 1, mode="edge"))[1:-1, 1:-1] > _ERODE_PX
        inside = eroded if eroded.any() else field
    # The border of the image is an edge too for a candidate: half an electrode cannot be placed.
    to_edge = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    margin = min(MARGIN_PX, min(field.shape) // 8)
    outside = np.flatnonzero(~inside)
    nearest = np.zeros(0, dtype=np.int64)
    if outside.size:
        v, u = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
        nearest = (v.astype(np.int64) * field.shape[1] + u).ravel()[outside]
    half = inside[::2, ::2]
    level = float(median[half].mean()) if half.any() else float(median.mean())
    return FieldMask(inside, to_edge > margin, outside, nearest, level)


def _step_inwards(line: NDArray[np.float32], reach: int) -> NDArray[np.float64]:
    """Relative step (after - before) / after at each place of each row of ``line``, means over ``reach`` pixels."""
    sums = np.cumsum(np.pad(line, ((0, 0), (1, 0))), axis=1, dtype=np.float64)
    means = (sums[:, reach:] - sums[:, :-reach]) / reach
    before, after = means[:, :-reach], means[:, reach:]
    steps: NDArray[np.float64] = (after - before) / np.maximum(after, 1e-6)
    return steps


def _within_straight_edges(median: Image, field: BoolArray) -> BoolArray:
    """Cut at blades parallel to the image's sides: a step to less than half, along most of the side, in its outer 40 %."""
    keep = np.ones(median.shape, dtype=np.bool_)
    reach = 4
    for quarter_turns in range(_SIDES):
        turned = np.rot90(median, quarter_turns)
        valid = np.rot90(field, quarter_turns)
        window = turned[:, : int(0.4 * turned.shape[1])]
        if window.shape[1] < 3 * reach:
            continue
        steps = _step_inwards(np.ascontiguousarray(window), reach)
        alive = valid[:, : window.shape[1]][:, 2 * reach - 1 : 2 * reach - 1 + steps.shape[1]]
        clear = (steps > 0.3) & alive
        share = clear.sum(axis=0) / max(0.5 * turned.shape[0], 1.0)
        level = np.array(
            [np.median(steps[alive[:, k], k]) if alive[:, k].any() else 0.0 for k in range(steps.shape[1])]
        )
        edges = np.flatnonzero((level > 0.3) & (share > 1.0))
        if edges.size:
            blade = int(edges[-1]) + reach
            side = np.rot90(keep, quarter_turns)
            side[:, : blade + 2] = False
    return keep


def _within_circle(median: Image, field: BoolArray) -> BoolArray:
    """Cut at a circular collimator or intensifier edge: the circle whose rim steps down outwards the most.

    Circles whose centre lies near the image's and whose radius is 0.3 to 0.75 of its width are tried on a quarter-size
    image. One is believed when the level falls by at least 30 % across its rim, over three quarters of the rim that is in
    the image, and half of the whole rim is.
    """
    keep = np.ones(median.shape, dtype=np.bool_)
    factor = max(1, min(median.shape) // 128)
    small = ndimage.gaussian_filter(reduce_by(median, factor), 1.0)
    rows, columns = small.shape
    if min(rows, columns) < 32:
        return keep
    size = min(rows, columns)
    angles = np.linspace(0, 2 * math.pi, 180, endpoint=False)
    rays = np.stack([np.cos(angles), np.sin(angles)])
    radii = np.arange(0.3 * size, 0.75 * size)
    offsets = np.linspace(-0.12, 0.12, 9) * size
    best, found = 0.0, None
    for off_v in offsets:
        for off_u in offsets:
            u = columns / 2 + off_u + np.multiply.outer(radii, rays[0])
            v = rows / 2 + off_v + np.multiply.outer(radii, rays[1])
            seen = (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)
            level = small[np.clip(np.rint(v), 0, rows - 1).astype(int), np.clip(np.rint(u), 0, columns - 1).astype(int)]
            inner, outer, both = level[:-4], level[4:], seen[:-4] & seen[4:]
            drop = np.where(both, (inner - outer) / np.maximum(inner, 1e-6), 0.0)
            rim = both.sum(axis=1)
            fallen = ((drop > 0.3) & both).sum(axis=1)
            good = (rim >= 90) & (fallen >= 0.75 * rim)
            score = np.where(good, drop.sum(axis=1) / np.maximum(rim, 1), 0.0)
            k = int(np.argmax(score))
            if score[k] > best:
                best, found = float(score[k]), (off_u + columns / 2, off_v + rows / 2, float(radii[k]) + 1.0)
    if found is None:
        return keep
    centre_u, centre_v, radius = (factor * value for value in found)
    v_half, u_half = np.ogrid[0 : median.shape[0], 0 : median.shape[1]]
    inside: BoolArray = (u_half - centre_u) ** 2 + (v_half - centre_v) ** 2 < radius**2
    return inside
