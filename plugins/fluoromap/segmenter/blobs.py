"""From the four-step filter's answer to candidate electrodes: Otsu's threshold, connected components, centroids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from fluoromap.contracts import Array, BoolArray, frozen
from fluoromap.segmenter.log_image import Image

_BINS = 1024
_EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=np.int8)


@dataclass(frozen=True, eq=False)
class Blobs:
    """Connected components of one frame.

    centroids_uv : (n, 2) pixels. areas_px : (n,).
    foreground : share of the field mask above the threshold.
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
    """Otsu's threshold of the pixels inside the mask, on 1024 grey levels from 0 to the largest value.

    Otsu, IEEE Trans. Syst. Man Cybern. 9 (1979) 62: the threshold that separates the two class means most.
    """
    highest = float(x.max())
    if not highest > 0:
        return highest
    counts = np.zeros(_BINS, np.int64)
    _count(x, inside, np.float32((_BINS - 1) / highest), counts)
    below = np.cumsum(counts)[:-1].astype(np.float64)
    above = counts.sum() - below
    sums = np.cumsum(counts * np.arange(_BINS))
    mean_below = sums[:-1] / np.maximum(below, 1)
    mean_above = (sums[-1] - sums[:-1]) / np.maximum(above, 1)
    level = int(np.argmax(below * above * (mean_below - mean_above) ** 2))
    return (level + 1) * highest / (_BINS - 1)


def find_blobs(x: Image, inside: BoolArray, candidates: BoolArray, smallest_px: float, largest_px: float) -> Blobs:
    """Threshold, label (8-connected) and measure.

    Parameters
    ----------
    x : (rows, columns) float32
        Answer of :func:`~fluoromap.segmenter.morphology.disk_morphology`: electrodes are bright.
    inside, candidates : (rows, columns) bool
        The field mask, in which the threshold is found, and where an electrode's centroid may lie.
    smallest_px, largest_px : float
        Limits of a component's area.
    """
    above = (x >= np.float32(otsu_threshold(x, inside))) & (x > 0) & inside
    foreground = float(np.count_nonzero(above)) / max(int(np.count_nonzero(inside)), 1)
    labels, count = ndimage.label(above, structure=_EIGHT_NEIGHBOURS)
    flat = np.flatnonzero(labels)
    of_pixel = labels.ravel()[flat]
    v, u = np.divmod(flat, x.shape[1])
    areas = np.bincount(of_pixel, minlength=count + 1)[1:].astype(np.float64)
    sums = np.stack([np.bincount(of_pixel, weights=w, minlength=count + 1)[1:] for w in (u, v)], axis=1)
    centroids = sums / np.maximum(areas, 1)[:, None]
    columns, rows = np.rint(centroids).astype(np.int64).T
    keep = (areas >= smallest_px) & (areas <= largest_px) & candidates[rows, columns]
    return Blobs(centroids[keep], areas[keep], foreground)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _count(x, inside, scale, counts):  # type: ignore[no-untyped-def]  # pragma: no cover
    for v in range(x.shape[0]):
        for u in range(x.shape[1]):
            if inside[v, u]:
                counts[int(x[v, u] * scale)] += 1
