"""From the four-step filter's answer to candidate electrodes: Otsu's threshold, connected components, centroids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from fluoromap.contracts import Array, BoolArray, frozen
from fluoromap.segmenter.log_image import Image

_BINS = 1024


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
        Answer of :func:`~fluoromap.segmenter.four_step.morphology.disk_morphology`: electrodes are bright.
    inside, candidates : (rows, columns) bool
        The field mask, in which the threshold is found, and where an electrode's centroid may lie.
    smallest_px, largest_px : float
        Limits of a component's area.
    """
    threshold = max(otsu_threshold(x, inside), float(np.finfo(np.float32).tiny))
    areas, centroids = components(x, inside, threshold)
    foreground = float(areas.sum()) / max(int(np.count_nonzero(inside)), 1)
    columns, rows = np.rint(centroids).astype(np.int64).T
    keep = (areas >= smallest_px) & (areas <= largest_px) & candidates[rows, columns]
    return Blobs(centroids[keep], areas[keep], foreground)


def components(x: Image, inside: BoolArray, threshold: float) -> tuple[Array, Array]:
    """8-connected components of what reaches ``threshold`` inside the mask, in the order of their first pixels.

    Returns
    -------
    areas_px : (n,). centroids_uv : (n, 2) pixels.
    """
    rows, columns = x.shape
    most = rows * ((columns + 1) // 2)
    spans = np.empty((most, 2), np.int32)
    parents = np.empty(most, np.int32)
    sums = np.empty((most, 3))
    count = _label(x, inside, np.float32(threshold), spans, parents, sums)
    of_component = sums[:count][parents[:count] == np.arange(count)]
    areas: Array = of_component[:, 0].copy()
    centroids: Array = of_component[:, 1:] / areas[:, None]
    return areas, centroids


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _count(x, inside, scale, counts):  # type: ignore[no-untyped-def]  # pragma: no cover
    for v in range(x.shape[0]):
        for u in range(x.shape[1]):
            if inside[v, u]:
                counts[int(x[v, u] * scale)] += 1


@njit(inline="always")
def _root(parents, node):  # type: ignore[no-untyped-def]  # pragma: no cover
    while parents[node] != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _label(x, inside, threshold, spans, parents, sums):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Union of the horizontal spans that touch, over their order. A component is the root of its spans, its first one;
    there ``sums`` holds its area and the sums of u and v. Returns the number of spans."""
    rows, columns = x.shape
    count = above = above_end = 0
    for v in range(rows):
        line, allowed = x[v], inside[v]
        first = count
        candidate = above
        u = 0
        while u < columns:
            if line[u] < threshold or not allowed[u]:
                u += 1
                continue
            start = u
            while u < columns and line[u] >= threshold and allowed[u]:
                u += 1
            spans[count, 0], spans[count, 1], parents[count] = start, u, count
            length = u - start
            sums[count, 0] = length
            sums[count, 1] = 0.5 * length * (start + u - 1)
            sums[count, 2] = length * v
            while candidate < above_end and spans[candidate, 1] < start:
                candidate += 1
            touching = candidate
            while touching < above_end and spans[touching, 0] <= u:
                one, other = _root(parents, touching), _root(parents, count)
                parents[max(one, other)] = min(one, other)
                touching += 1
            count += 1
        above, above_end = first, count
    for span in range(count):
        root = _root(parents, span)
        if root != span:
            for k in range(3):
                sums[root, k] += sums[span, k]
    return count
