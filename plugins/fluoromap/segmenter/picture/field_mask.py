"""The exposed part of a run's images; no electrode lies outside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import points_in_poly

from fluoromap.contracts import Array, BoolArray, FrameSource, IntArray, PixelFacts, Shutter
from fluoromap.segmenter.picture.burnt_in import burnt_in_text
from fluoromap.segmenter.picture.collimator import within_collimator
from fluoromap.segmenter.picture.gaussian_blur import gaussian, reduce_by
from fluoromap.segmenter.picture.log_image import Image

MARGIN_PX, EDGE_PX = 16, 5
"""Candidates closer than this to the edge of the field are ignored, pixels: at first, and where catheters lack or two are sure."""

_SAMPLES = 15
_DARK = 0.06
_ERODE_PX = 10
_MEDIAN_OF = 9


_Pixel = TypeVar("_Pixel", bound=np.generic)


@dataclass(frozen=True, eq=False)
class ExposedField:
    """What the frames show of the field; all else about it follows.

    inside : the eroded field; text : burnt-in text; both (rows, columns) of half the size.
    mean_level : mean stored grey level inside, over the sampled frames.
    """

    inside: BoolArray
    text: BoolArray
    mean_level: float


@dataclass(frozen=True, eq=False)
class FieldMask:
    """The field of one run.

    inside : the eroded field; candidates : pixels where electrodes may lie; with_edge : the same and those near the edge;
    all (rows, columns).
    outside, nearest : flat indices of the pixels outside the field or on burnt-in text and, for each, of the nearest other pixel.
    mean_level : mean stored grey level inside, over the sampled frames.
    """

    inside: BoolArray
    candidates: BoolArray
    with_edge: BoolArray
    outside: IntArray
    nearest: IntArray
    mean_level: float

    def fill(self, x: Image) -> Image:
        """Overwrite the pixels outside the field and on text, in place.

        Each gets the nearest value inside. Without this the filters respond to the edge of the collimator and to letters.
        """
        if self.outside.size:
            flat = x.reshape(-1)
            flat[self.outside] = flat[self.nearest]
        return x


def are_in(field: BoolArray, points_uv: Array) -> BoolArray:
    """Return which points lie in a part of the image, (n,)."""
    pixels = np.rint(points_uv).astype(np.int64)
    nearest = np.minimum(np.maximum(pixels, 0), np.array(field.shape[::-1]) - 1)
    inside: BoolArray = field[nearest[:, 1], nearest[:, 0]] & (pixels == nearest).all(axis=1)
    return inside


def find_field(frames: FrameSource, facts: PixelFacts) -> FieldMask:
    """Return the field mask of a run."""
    return field_mask(exposed_field(frames, facts), frames.shape)


def exposed_field(frames: FrameSource, facts: PixelFacts) -> ExposedField:
    """Return the exposed part of a run's images.

    Shutter attributes are used where the header has them. Otherwise the median of at most 9 evenly spaced frames is cut
    at 6 % of its bright level, and at straight and circular collimator edges that are fitted to it. A grey level alone
    either keeps the penumbra of the collimator or removes dark parts of the patient. The field is eroded by 10 px. All
    steps use half the size. Burnt-in text is filled before: beyond the collimator's edge it is as bright as the field.
    """
    samples = [frames[index] for index in evenly_spaced_frames(len(frames), _MEDIAN_OF)]
    text = reduce_by(burnt_in_text(samples).astype(np.float32), 2) > 0
    median = _median(samples)
    if text.any():
        median = median[tuple(_nearest_place(text))]
    if facts.shutter is not None:
        v, u = 2.0 * np.mgrid[0 : median.shape[0], 0 : median.shape[1]] + 0.5
        field = inside_shutter(facts.shutter, u, v)
    else:
        lit = np.float32(2**facts.bits_stored - 1) - median if facts.monochrome1 else median
        field = bright_region(lit) & within_collimator(lit)
    field = _largest_part(field)
    if np.count_nonzero(field) < 0.02 * field.size:
        field = np.ones(median.shape, dtype=np.bool_)
    inside = field
    if not field.all():  # the distance transform needs a background
        eroded = ndimage.distance_transform_edt(np.pad(field, 1, mode="edge"))[1:-1, 1:-1] > 0.5 * _ERODE_PX
        inside = eroded if eroded.any() else field
    return ExposedField(inside, text, float(median[inside].mean()))


def field_mask(exposed: ExposedField, shape: tuple[int, int]) -> FieldMask:
    """Return the field mask of images (rows, columns) from their exposed part."""
    inside, text = exposed.inside, exposed.text
    # A candidate also needs a margin to the border of the image: half an electrode cannot be located.
    to_edge = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    candidates, with_edge = (
        _double_size((to_edge > 0.5 * min(margin, min(shape) // 8)) & ~text, shape) for margin in (MARGIN_PX, EDGE_PX)
    )
    whole = _double_size(inside, shape)
    hidden = ~inside | text
    outside = np.flatnonzero(_double_size(hidden, shape))
    nearest = np.zeros(0, dtype=np.int64)
    if outside.size:
        v, u = _nearest_place(hidden)
        nearest = _double_size(2 * (v * shape[1] + u), shape).ravel()[outside]
    return FieldMask(whole, candidates, with_edge, outside, nearest, exposed.mean_level)


def evenly_spaced_frames(count: int, most: int = _SAMPLES) -> list[int]:
    """Return frame numbers spread evenly over a run.

    There are at most ``most`` of the ``count`` frames.
    """
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, most)).tolist()})


def inside_shutter(shutter: Shutter, u: Array, v: Array) -> BoolArray:
    """Return which places lie inside all shapes of the shutter.

    The shapes are those of ShutterShape (DICOM PS3.3 C.8.7.3); the collimator's attributes have the same form.

    Parameters
    ----------
    shutter : Shutter
    u, v : (rows, columns)
        Places in pixels.
    """
    inside = np.ones(u.shape, dtype=np.bool_)
    if shutter.rectangle is not None:
        left, right, upper, lower = shutter.rectangle
        inside &= (u > left) & (u < right) & (v > upper) & (v < lower)
    if shutter.circle is not None:
        centre_u, centre_v, radius = shutter.circle
        inside &= (u - centre_u) ** 2 + (v - centre_v) ** 2 < radius**2
    if shutter.polygon is not None and len(shutter.polygon) >= 3:
        places = np.stack([u.ravel(), v.ravel()], axis=1)
        corners = np.asarray(shutter.polygon, dtype=np.float64)
        inside &= points_in_poly(places, corners).reshape(u.shape)  # type: ignore[no-untyped-call]
    return inside


def bright_region(median: Image) -> BoolArray:
    """Return the largest connected part above 6 % of the bright level.

    Its holes are filled.
    """
    smooth = gaussian(median, 1.0)
    return _largest_part(smooth > _DARK * np.percentile(smooth, 95))


def _median(samples: Sequence[NDArray[np.generic]]) -> Image:
    stack = np.stack([reduce_by(frame.astype(np.float32), 2) for frame in samples], axis=2)
    stack.sort(axis=2)
    median: Image = stack[:, :, len(samples) // 2].copy()
    return median


def _nearest_place(hidden: BoolArray) -> IntArray:
    """Return row and column of the nearest pixel that is not hidden, (2, rows, columns)."""
    nearest = ndimage.distance_transform_edt(hidden, return_distances=False, return_indices=True)
    return np.asarray(nearest, np.int64)


def _largest_part(field: BoolArray) -> BoolArray:
    labels, count = ndimage.label(field)
    if count > 1:
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        field = labels == int(np.argmax(sizes))
    filled: BoolArray = ndimage.binary_fill_holes(field)
    return filled


def _double_size(half: NDArray[_Pixel], shape: tuple[int, int]) -> NDArray[_Pixel]:
    whole = np.repeat(np.repeat(half, 2, axis=0), 2, axis=1)[: shape[0], : shape[1]]
    return np.ascontiguousarray(whole)
