"""Contrast of a place: how much darker it is than its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.picture.gaussian_blur import gaussian, reduce_by
from fluoromap.segmenter.picture.log_image import Image

_CORE_MM = 0.55
_RING_MM = (1.5, 2.0)
_GRID = 24
_PEAK_MM = (0.35, 0.7)
_MOST_PEAKS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Contrast:
    """Contrast measurement on one frame.

    image : (rows, columns) float32 log units. noise : robust standard deviation of :meth:`of` over the field: photon noise
    and anatomy together. px_per_mm : at the isocentre.
    """

    image: Image
    noise: float
    px_per_mm: float

    @classmethod
    def of_frame(cls, image: Image, inside: BoolArray, px_per_mm: float) -> Contrast:
        """Measure the noise of the contrast on a grid of places inside the field."""
        rows, columns = image.shape
        v, u = np.meshgrid(
            np.linspace(0, rows - 1, _GRID).round(), np.linspace(0, columns - 1, _GRID).round(), indexing="ij"
        )
        places = np.stack([u.ravel(), v.ravel()], axis=1)
        places = places[inside[places[:, 1].astype(int), places[:, 0].astype(int)]]
        values = _centre_surround(image, places, *_radii(px_per_mm)) if len(places) else np.zeros(1)
        noise = 1.4826 * float(np.median(np.abs(values - np.median(values))))
        return cls(image, max(noise, 1e-6), px_per_mm)

    def of(self, points_uv: Array) -> Array:
        """Return contrast over noise at each point, (n,).

        The contrast is the mean of the surroundings less the mean of the centre: positive where dark.
        """
        return _centre_surround(self.image, points_uv, *_radii(self.px_per_mm)) / self.noise  # type: ignore[no-any-return]

    def peaks(self, candidates: BoolArray, threshold: float = 8.0) -> Array:
        """Return dark places that exceed ``threshold`` times the noise, (n, 2) pixels.

        They are maxima of a difference of Gaussians of ring size on the half-size image, strongest first.
        """
        half = reduce_by(self.image, 2)
        narrow, wide = (max(0.5, 0.5 * size * self.px_per_mm) for size in _PEAK_MM)
        response = gaussian(half, wide) - gaussian(half, narrow)
        found = np.empty((response.size // 4, 3))
        peaks = found[: _local_maxima(response, found)]
        peaks = peaks[np.argsort(-peaks[:, 2], kind="stable")][:_MOST_PEAKS]
        places = 2.0 * peaks[:, :2] + 0.5
        rows, columns = self.image.shape
        allowed = candidates[
            np.minimum(places[:, 1].astype(int), rows - 1), np.minimum(places[:, 0].astype(int), columns - 1)
        ]
        places = places[allowed]
        clear: Array = places[self.of(places) >= threshold]
        return clear


def _radii(px_per_mm: float) -> tuple[float, float, float]:
    return max(1.0, _CORE_MM * px_per_mm), max(3.0, _RING_MM[0] * px_per_mm), max(4.5, _RING_MM[1] * px_per_mm)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _local_maxima(x, found):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write each positive maximum as (u, v, value); return their number.

    No pixel within two of a maximum exceeds it. skimage.feature.peak_local_max takes 35 times as long, and SciPy's
    maximum filter three times.
    """
    rows, columns = x.shape
    count = 0
    for v in range(rows):
        line, up, down = x[v], x[max(v - 1, 0)], x[min(v + 1, rows - 1)]
        for u in range(columns):
            value = line[u]
            if value <= 0 or value < line[max(u - 1, 0)] or value < line[min(u + 1, columns - 1)]:
                continue
            if value < up[u] or value < down[u]:
                continue
            highest = True
            for near in range(max(v - 2, 0), min(v + 3, rows)):
                for across in range(max(u - 2, 0), min(u + 3, columns)):
                    if x[near, across] > value:
                        highest = False
            if highest and count < found.shape[0]:
                found[count, 0], found[count, 1], found[count, 2] = u, v, value
                count += 1
    return count


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _centre_surround(x, points, core, near, far):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = x.shape
    reach = int(far) + 1
    out = np.zeros(points.shape[0], np.float64)
    for i in range(points.shape[0]):
        cu, cv = points[i, 0], points[i, 1]
        inner = outer = 0.0
        n_inner = n_outer = 0
        for v in range(max(int(cv) - reach, 0), min(int(cv) + reach + 2, rows)):
            for u in range(max(int(cu) - reach, 0), min(int(cu) + reach + 2, columns)):
                square = (u - cu) ** 2 + (v - cv) ** 2
                if square <= core * core:
                    inner += x[v, u]
                    n_inner += 1
                elif near * near <= square <= far * far:
                    outer += x[v, u]
                    n_outer += 1
        if n_inner > 0 and n_outer > 0:
            out[i] = outer / n_outer - inner / n_inner
    return out
