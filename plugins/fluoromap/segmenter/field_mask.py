"""The exposed part of a run's images, found once a run; nothing outside it is ever an electrode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from fluoromap.contracts import Array, BoolArray, FrameSource, IntArray, PixelFacts, Shutter
from fluoromap.segmenter.collimator import within_collimator
from fluoromap.segmenter.gaussian_blur import gaussian, reduce_by
from fluoromap.segmenter.log_image import Image

MARGIN_PX = 16
"""Nothing closer to the edge of the field is a candidate."""

_SAMPLES = 15
_DARK = 0.06
_ERODE_PX = 10
_MEDIAN_OF = 9


_Pixel = TypeVar("_Pixel", bound=np.generic)


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

    What shutter attributes tell is believed. Else the median of at most 9 evenly spaced frames is cut at 6 % of its bright
    level, and at straight and circular collimator edges fitted to it: a grey level alone either keeps the penumbra of the
    collimator or cuts truly dark halves of the patient. The result is eroded by 10 px. All of it at half size.
    """
    median = _median_of_samples(frames)
    if facts.shutter is not None:
        field = _inside_shutter_at_half_size(facts.shutter, median.shape)
    else:
        lit = np.float32(2**facts.bits_stored - 1) - median if facts.monochrome1 else median
        field = bright_region(lit) & within_collimator(lit)
    field = _largest_part(field)
    if np.count_nonzero(field) < 0.02 * field.size:
        field = np.ones(median.shape, dtype=np.bool_)
    return _mask(field, median, frames.shape)


def evenly_spaced(count: int, most: int = _SAMPLES) -> list[int]:
    """At most 15 (or ``most``) frames spread over a run of ``count``."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, most)).tolist()})


def inside_shutter(shutter: Shutter, shape: tuple[int, int]) -> BoolArray:
    """Pixels inside all shapes of the shutter (DICOM PS3.3 C.8.7.3: ShutterShape, and the collimator's alike)."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    return _inside_shapes(shutter, u, v)


def _inside_shutter_at_half_size(shutter: Shutter, shape: tuple[int, ...]) -> BoolArray:
    v, u = 2.0 * np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    return _inside_shapes(shutter, u, v)


def _inside_shapes(shutter: Shutter, u: Array, v: Array) -> BoolArray:
    inside = np.ones(u.shape, dtype=np.bool_)
    if shutter.rectangle is not None:
        left, right, upper, lower = shutter.rectangle
        inside &= (u > left) & (u < right) & (v > upper) & (v < lower)
    if shutter.circle is not None:
        centre_u, centre_v, radius = shutter.circle
        inside &= (u - centre_u) ** 2 + (v - centre_v) ** 2 < radius**2
    if shutter.polygon is not None and len(shutter.polygon) >= 3:
        corners = np.asarray(shutter.polygon, dtype=np.float64)
        crossings = np.zeros(u.shape, dtype=np.bool_)
        for (u0, v0), (u1, v1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if v0 != v1:
                at = u0 + (v - v0) * (u1 - u0) / (v1 - v0)
                crossings ^= ((v0 <= v) != (v1 <= v)) & (u < at)
        inside &= crossings
    return inside


def bright_region(median: Image) -> BoolArray:
    """Pixels above 6 % of the bright level, the largest connected part, holes filled."""
    smooth = gaussian(median, 1.0)
    return _largest_part(smooth > _DARK * np.percentile(smooth, 95))


def _median_of_samples(frames: FrameSource) -> Image:
    chosen = evenly_spaced(len(frames), _MEDIAN_OF)
    stack = np.stack([reduce_by(frames[index].astype(np.float32), 2) for index in chosen], axis=2)
    stack.sort(axis=2)
    median: Image = stack[:, :, len(chosen) // 2].copy()
    return median


def _largest_part(field: BoolArray) -> BoolArray:
    labels, count = ndimage.label(field)
    if count > 1:
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        field = labels == int(np.argmax(sizes))
    filled: BoolArray = ndimage.binary_fill_holes(field)
    return filled


def _mask(half: BoolArray, median: Image, shape: tuple[int, int]) -> FieldMask:
    inside = half
    if not half.all():  # a transform without any background has no meaning
        eroded = ndimage.distance_transform_edt(np.pad(half, 1, mode="edge"))[1:-1, 1:-1] > 0.5 * _ERODE_PX
        inside = eroded if eroded.any() else half
    # The border of the image is an edge too for a candidate: half an electrode cannot be placed.
    to_edge = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    candidates = to_edge > 0.5 * min(MARGIN_PX, min(shape) // 8)
    whole = _twice(inside, shape)
    outside = np.flatnonzero(~whole)
    nearest = np.zeros(0, dtype=np.int64)
    if outside.size:
        v, u = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
        nearest = _twice(2 * (v.astype(np.int64) * shape[1] + u), shape).ravel()[outside]
    return FieldMask(whole, _twice(candidates, shape), outside, nearest, float(median[inside].mean()))


def _twice(half: NDArray[_Pixel], shape: tuple[int, int]) -> NDArray[_Pixel]:
    whole = np.repeat(np.repeat(half, 2, axis=0), 2, axis=1)[: shape[0], : shape[1]]
    return np.ascontiguousarray(whole)
