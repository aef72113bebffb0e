"""Dark blobs of electrode size: the Laplacian of Gaussians of a log image at three scales, and its maxima."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.homomorphic import gaussian, reduce_by
from fluoromap.segmenter.log_image import Image

_SCALES_MM = 0.52, 0.73, 1.04
_SHAFT_SCALE_MM = 0.52
_LEAST_RING_PX = 5.0
_CLEAR_SNR = 4.0
_APART_MM = 0.57
_MOST = 60
_FOUND = 4000
_GAUSSIAN_SD = 1.4826


@dataclass(frozen=True, slots=True, eq=False)
class BlobResponse:
    """Response of one log image to dark blobs.

    stack : (3, rows, columns) float32, scale-normalised half Laplacian in log units, positive where dark; image size over
    ``reduction``. best : (rows, columns) the same over noise, the largest of the scales. noise : (3,) robust standard
    deviation of ``stack`` inside the field. smooth : (rows, columns) the reduced log image at the smallest scale.
    pixel_noise : standard deviation of a pixel of the reduced log image.
    """

    stack: Image
    best: Image
    noise: Array
    smooth: Image
    pixel_noise: float
    reduction: int
    px_per_mm: float

    @classmethod
    def of_image(cls, x: Image, inside: BoolArray, ring_mm: float, px_per_mm: float) -> BlobResponse:
        """Response of a log image, worked out at half its size unless a ring would be narrower than 5 px of the frame."""
        reduction = 2 if ring_mm * px_per_mm >= _LEAST_RING_PX and min(x.shape) >= 64 else 1
        small = reduce_by(x, 2) if reduction == 2 else x
        scale = px_per_mm / reduction
        stack = np.zeros((len(_SCALES_MM), *small.shape), np.float32)
        blurred, before, smooth = small, 0.0, small
        for level, sigma_mm in enumerate(_SCALES_MM):
            sigma = max(sigma_mm * scale, 0.7 * (level + 1))
            blurred = gaussian(blurred, math.sqrt(sigma**2 - before**2))
            before = sigma
            if level == 0:
                smooth = blurred
            _half_laplacian(blurred, np.float32(sigma**2), stack[level])
        valid = inside[::reduction, ::reduction][::3, ::3]
        noise = np.array([_spread(level[::3, ::3][valid]) for level in stack])
        differences = (small[::4, 1::2] - small[::4, :-1:2])[inside[::reduction, ::reduction][::4, 1::2]]
        best = (stack / noise.astype(np.float32)[:, None, None]).max(axis=0)
        return cls(stack, best, noise, smooth, _spread(differences) / math.sqrt(2.0), reduction, px_per_mm)

    def candidates(self, allowed: BoolArray, expected: int) -> tuple[Array, Array]:
        """Maxima over u, v and scale above 4 robust standard deviations.

        Scales compete by response: by response over noise, a long tip would split in two. What is weaker than a fifth of
        the ``expected``-th best is dropped.

        Returns
        -------
        points_uv : (n, 2) pixels of the frame, sub-pixel. snr : (n,) response over noise, strongest response first.
        """
        found = np.empty((_FOUND, 3), np.int64)
        count = _maxima(self.stack, _CLEAR_SNR * self.noise, allowed, self.reduction, found)
        scale, v, u = found[:count].T
        strongest = np.argsort(-self.stack[scale, v, u], kind="stable")[:300]
        scale, v, u = scale[strongest], v[strongest], u[strongest]
        places = self._sub_pixel(scale, v, u)
        keep = np.empty(len(places), np.bool_)
        _apart(places, _APART_MM * self.px_per_mm / self.reduction, keep)
        kept = np.flatnonzero(keep)[:_MOST]
        scale, places = scale[kept], places[kept]
        snr = self.stack[scale, v[kept], u[kept]] / self.noise[scale]
        if len(snr) > expected:
            keep = snr >= 0.2 * np.sort(snr)[-expected]
            places, snr = places[keep], snr[keep]
        shift = 0.5 * (self.reduction - 1)
        return places * self.reduction + shift, snr

    def _sub_pixel(self, scale: IntArray, v: IntArray, u: IntArray) -> Array:
        """Tops of the paraboloids through these maxima and their neighbours, (n, 2) pixels of ``stack``."""
        steps = np.arange(-1, 2)
        near = self.stack[scale[:, None, None], v[:, None, None] + steps[:, None], u[:, None, None] + steps]
        near = near.astype(np.float64)
        gu, gv = 0.5 * (near[:, 1, 2] - near[:, 1, 0]), 0.5 * (near[:, 2, 1] - near[:, 0, 1])
        uu = near[:, 1, 2] + near[:, 1, 0] - 2.0 * near[:, 1, 1]
        vv = near[:, 2, 1] + near[:, 0, 1] - 2.0 * near[:, 1, 1]
        uv = 0.25 * (near[:, 2, 2] + near[:, 0, 0] - near[:, 0, 2] - near[:, 2, 0])
        determinant = uu * vv - uv * uv
        moves = np.stack([uv * gv - vv * gu, uv * gu - uu * gv], axis=1)
        curved = determinant > 0
        moves[curved] /= determinant[curved, None]
        moves[~curved] = 0.0
        tops: Array = np.stack([u, v], axis=1) + np.clip(moves, -1.0, 1.0)
        return tops

    def at(self, points_uv: Array) -> Array:
        """Response over noise at points of the frame, the best scale of each, (n,)."""
        rows, columns = self.smooth.shape
        places = (points_uv - 0.5 * (self.reduction - 1)) / self.reduction
        u = np.minimum(np.maximum(np.rint(places[:, 0]), 0), columns - 1).astype(np.int64)
        v = np.minimum(np.maximum(np.rint(places[:, 1]), 0), rows - 1).astype(np.int64)
        over_noise: Array = self.best[v, u].astype(np.float64)
        return over_noise


def _spread(values: Image) -> float:
    if not values.size:
        return 1e-6
    middle = values.size // 2
    return max(_GAUSSIAN_SD * float(np.partition(np.abs(values), middle)[middle]), 1e-6)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _half_laplacian(x, square, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = x.shape
    half = np.float32(0.5) * square
    four = np.float32(4)
    for v in range(1, rows - 1):
        up, middle, down, row = x[v - 1, 1:-1], x[v], x[v + 1, 1:-1], out[v, 1:-1]
        left, centre, right = middle[: columns - 2], middle[1:-1], middle[2:]
        for u in range(columns - 2):
            row[u] = half * (up[u] + down[u] + left[u] + right[u] - four * centre[u])


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _maxima(stack, floor, allowed, reduction, found):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes (scale, v, u) of each maximum to ``found``; returns how many."""
    scales, rows, columns = stack.shape
    count = 0
    for s in range(scales):
        least = floor[s]
        for v in range(1, rows - 1):
            for u in range(1, columns - 1):
                value = stack[s, v, u]
                if value <= least or not allowed[v * reduction, u * reduction]:
                    continue
                highest = True
                for k in range(9 * scales):
                    t, dv, du = k // 9, k // 3 % 3 - 1, k % 3 - 1
                    other = stack[t, v + dv, u + du]
                    # Of equal neighbours in one scale, the first counts.
                    if other > value or (other == value and t == s and (dv, du) < (0, 0)):
                        highest = False
                        break
                if highest and count < found.shape[0]:
                    found[count, 0], found[count, 1], found[count, 2] = s, v, u
                    count += 1
    return count


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _apart(places, distance, keep):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Says in ``keep`` which of these, in order, lie farther than ``distance`` from all kept before."""
    for i in range(places.shape[0]):
        keep[i] = True
        for j in range(i):
            du, dv = places[i, 0] - places[j, 0], places[i, 1] - places[j, 1]
            if keep[j] and du * du + dv * dv < distance * distance:
                keep[i] = False
                break
