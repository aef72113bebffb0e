"""Candidate electrodes: Otsu's threshold, connected components, centroids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from skimage.filters import threshold_otsu
from skimage.measure import label

from fluoromap.contracts import Array, BoolArray, frozen
from fluoromap.segmenter.picture.log_image import Image

MOST_FOREGROUND = 0.02
"""Above this share of the field the threshold has separated noise or contrast medium from the rest, not electrodes."""

_BINS = 1024


@dataclass(frozen=True, eq=False)
class Blobs:
    """Connected components of one frame.

    centroids_uv : (n, 2) pixels. areas_px : (n,). foreground : share of the field mask above the threshold.
    """

    centroids_uv: Array
    areas_px: Array
    foreground: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centroids_uv", frozen(self.centroids_uv, (None, 2), "centroids_uv"))
        object.__setattr__(self, "areas_px", frozen(self.areas_px, (len(self.centroids_uv),), "areas_px"))

    def __len__(self) -> int:
        return len(self.areas_px)


def otsu_threshold(x: Image, inside: BoolArray) -> float:
    """Return Otsu's threshold of the pixels inside the mask.

    The histogram has 1024 grey levels from 0 to the largest value of the image.
    """
    highest = float(x.max())
    if not highest > 0:
        return highest
    counts = np.zeros(_BINS, np.int64)
    _count(x, inside, np.float32((_BINS - 1) / highest), counts)
    upper_edges = np.arange(1, _BINS + 1) * highest / (_BINS - 1)
    levels = np.flatnonzero(counts)
    if len(levels) < 2:
        return float(upper_edges[0])
    # Empty bins at either end would make the class means of scikit-image undefined.
    occupied = slice(levels[0], levels[-1] + 1)
    return float(threshold_otsu(hist=(counts[occupied], upper_edges[occupied])))  # type: ignore[no-untyped-call]


def find_blobs(x: Image, inside: BoolArray, candidates: BoolArray, smallest_px: float, largest_px: float) -> Blobs:
    """Return the connected components above Otsu's threshold.

    The function measures no component where the foreground exceeds :data:`MOST_FOREGROUND`.

    Parameters
    ----------
    x : (rows, columns) float32
        Result of :func:`~fluoromap.segmenter.four_step.morphology.disk_morphology`: electrodes are bright.
    inside, candidates : (rows, columns) bool
        The field mask, in which the threshold is computed, and the pixels where an electrode's centroid may lie.
    smallest_px, largest_px : float
        Limits of a component's area, square pixels.
    """
    threshold = max(otsu_threshold(x, inside), float(np.finfo(np.float32).tiny))
    bright = (x >= np.float32(threshold)) & inside
    foreground = int(np.count_nonzero(bright)) / max(int(np.count_nonzero(inside)), 1)
    if foreground > MOST_FOREGROUND:
        return Blobs(np.zeros((0, 2)), np.zeros(0), foreground)
    areas, centroids = components(bright)
    columns, rows = np.rint(centroids).astype(np.int64).T
    keep = (areas >= smallest_px) & (areas <= largest_px) & candidates[rows, columns]
    return Blobs(centroids[keep], areas[keep], foreground)


def components(bright: BoolArray) -> tuple[Array, Array]:
    """Return areas and centroids of the 8-connected components.

    Components have the order of their first pixels.

    Returns
    -------
    areas_px : (n,)
    centroids_uv : (n, 2) pixels
    """
    labels = label(bright, connectivity=2).reshape(-1)  # type: ignore[no-untyped-call]
    pixels = np.flatnonzero(labels)
    component = labels[pixels] - 1
    v, u = np.divmod(pixels, bright.shape[1])
    # scikit-image's regionprops gives the same numbers, but takes four times as long for 345 components.
    areas = np.bincount(component).astype(np.float64)
    centroids: Array = np.stack([np.bincount(component, u), np.bincount(component, v)], axis=1) / areas[:, None]
    return areas, centroids


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _count(x, inside, scale, counts):  # type: ignore[no-untyped-def]  # pragma: no cover
    for v in range(x.shape[0]):
        for u in range(x.shape[1]):
            if inside[v, u]:
                counts[int(x[v, u] * scale)] += 1
