"""Dark blobs of electrode size: Laplacians of Gaussians at three scales, and their maxima."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.electrodes.proposals import Likeness, Proposals, log_odds, probability_of_contrast
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.gaussian_blur import gaussian, reduce_by
from fluoromap.segmenter.picture.log_image import Image, pixel_noise, robust_sd

_SCALES_MM = 0.52, 0.73, 1.04
_LEAST_RING_PX = 5.0
_CLEAR_SNR = 4.0
_APART_MM = 0.57
_MOST = 60
_BLUR_MM = 1.75
_OF_NOISE, _OF_STRUCTURES = 0.48, 0.44
"""What the variances of a pixel at half the size and at an eighth displace electrodes by. Fitted to simulated runs."""


@dataclass(frozen=True, slots=True, eq=False)
class BlobResponse:
    """Response of one log image to dark blobs.

    stack : (3, rows, columns) float32, scale-normalised half Laplacian in log units, positive where dark; image size
    over ``reduction``.
    best : (rows, columns), the largest of the three scales, each over its noise.
    noise : (3,) robust standard deviation of ``stack`` inside the field.
    smooth : (rows, columns) the reduced log image at the smallest scale.
    pixel_noise : standard deviation of a pixel of the reduced log image.
    position_noise : what displaces electrodes, as the noise of a pixel of the image at half its size, whatever the reduction:
    compression removes noise between neighbouring pixels, but at half the size it stays. Structures of the size of electrodes
    displace them too, and a mean of frames has as many of them as a frame.
    """

    stack: Image
    best: Image
    noise: Array
    smooth: Image
    pixel_noise: float
    position_noise: float
    reduction: int
    px_per_mm: float

    @classmethod
    def of_image(cls, x: Image, inside: BoolArray, ring_mm: float, px_per_mm: float) -> BlobResponse:
        """Compute the response of a log image.

        The image is halved unless a ring would be narrower than 5 px of the frame.
        """
        reduction = 2 if ring_mm * px_per_mm >= _LEAST_RING_PX and min(x.shape) >= 64 else 1
        small = reduce_by(x, 2) if reduction == 2 else x
        scale = px_per_mm / reduction
        stack = np.empty((len(_SCALES_MM), *small.shape), np.float32)
        blurred, before, smooth = small, 0.0, small
        for level, sigma_mm in enumerate(_SCALES_MM):
            sigma = max(sigma_mm * scale, 0.7 * (level + 1))
            blurred = gaussian(blurred, math.sqrt(sigma**2 - before**2))
            before = sigma
            if level == 0:
                smooth = blurred
            _half_laplacian(blurred, sigma, stack[level])
        valid = inside[::reduction, ::reduction][::3, ::3]
        noise = np.array([robust_sd(level[::3, ::3][valid]) for level in stack])
        best, other = np.empty(small.shape, np.float32), np.empty(small.shape, np.float32)
        np.multiply(stack[0], np.float32(1.0 / noise[0]), out=best)
        for level in range(1, len(stack)):
            np.multiply(stack[level], np.float32(1.0 / noise[level]), out=other)
            np.maximum(best, other, out=best)
        of_pixels = pixel_noise(small, inside[::reduction, ::reduction])
        half = small if reduction == 2 else reduce_by(x, 2)
        of_half = of_pixels if reduction == 2 else max(of_pixels, _noise_of(half, inside, 2))
        of_structures = _noise_of(reduce_by(half, 4), inside, 8)
        of_positions = math.sqrt(_OF_NOISE * of_half**2 + _OF_STRUCTURES * of_structures**2)
        return cls(stack, best, noise, smooth, of_pixels, of_positions, reduction, px_per_mm)

    @property
    def nbytes(self) -> int:
        """Memory of the images, bytes."""
        return self.stack.nbytes + self.best.nbytes + self.smooth.nbytes

    def without_stack(self) -> BlobResponse:
        """Return what answers about places need; it makes no proposals."""
        return replace(self, stack=np.empty((0, *self.smooth.shape), np.float32))

    @property
    def likeness(self) -> Likeness:
        """Response over noise."""
        return Likeness(self.best, self.reduction, 0.5 * (self.reduction - 1))

    def proposals(self, allowed: BoolArray, expected: int) -> Proposals:
        """Return the maxima over u, v and scale, strongest response first.

        They are above 4 robust standard deviations. Scales compete by response. With response over noise, a long tip
        would split in two. Candidates weaker than a fifth of the ``expected``-th best are dropped.
        """
        scale, v, u = self._maxima(allowed[:: self.reduction, :: self.reduction])
        strongest = np.argsort(-self.stack[scale, v, u], kind="stable")[:300]
        scale, v, u = scale[strongest], v[strongest], u[strongest]
        places = self._sub_pixel(scale, v, u)
        kept = np.flatnonzero(_apart(places, _APART_MM * self.px_per_mm / self.reduction))[:_MOST]
        scale, places = scale[kept], places[kept]
        snr = self.stack[scale, v[kept], u[kept]] / self.noise[scale]
        if len(snr) > expected:
            keep = snr >= 0.2 * np.sort(snr)[-expected]
            places, snr = places[keep], snr[keep]
        shift = 0.5 * (self.reduction - 1)
        variance = self._variance(snr)
        return Proposals(
            places * self.reduction + shift, probability_of_contrast(snr), variance[:, None, None] * np.eye(2)
        )

    def _maxima(self, allowed: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
        """Return scale, v and u of the maxima.

        A maximum is over place and scale. ``allowed`` is False at the border. skimage.feature.peak_local_max takes 10
        to 50 times as long.
        """
        first, second, third = self.stack
        top = np.maximum(np.maximum(first, second), third).reshape(-1)
        columns = self.stack.shape[2]
        # A little less than needed, because ``best`` is rounded.
        clear = np.flatnonzero(self.best.reshape(-1) > np.float32(0.999 * _CLEAR_SNR))
        clear = clear[allowed[np.divmod(clear, columns)]]
        for step in (1, -1, columns, -columns, columns + 1, columns - 1, 1 - columns, -1 - columns):
            clear = clear[top[clear] >= top[clear + step]]
        v, u = np.divmod(clear, columns)
        scale = np.argmax(self.stack[:, v, u], axis=0)
        clear = top[clear] > _CLEAR_SNR * self.noise[scale]
        return scale[clear], v[clear], u[clear]

    def _sub_pixel(self, scale: IntArray, v: IntArray, u: IntArray) -> Array:
        """Return the tops of the paraboloids through the maxima, (n, 2) pixels of ``stack``."""
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
        tops: Array = np.stack([u, v], axis=1) + np.minimum(np.maximum(moves, -1.0), 1.0)
        return tops

    def halves_of_pairs(self, allowed: BoolArray) -> Proposals:
        """Return none: a blob says nothing of a second electrode in it."""
        return Proposals(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)))

    def tip_logits_at(self, points_uv: Array) -> Array:
        """Return zeros: a blob does not show which end it is."""
        return np.zeros(len(points_uv))

    def probability_at(self, points_uv: Array) -> Array:
        """Return the probability of electrodes at points of the frame, (n,)."""
        return probability_of_contrast(self.scores_at(points_uv))

    def kind_odds_at(self, points_uv: Array) -> Array:
        """Return the log-odds of electrodes at points, (n,): blobs know nothing else of them."""
        return log_odds(self.probability_at(points_uv))

    unseen_probability_at = probability_at

    def variance_at(self, points_uv: Array) -> Array:
        """Return the variance of places at these points, (n,) pixels squared.

        It is that of maxima as strong as the response there.
        """
        return self._variance(self.scores_at(points_uv))

    def _variance(self, snr: Array) -> Array:
        variance: Array = (_BLUR_MM * self.px_per_mm / np.maximum(snr, 1.0)) ** 2
        return variance

    def scores_at(self, points_uv: Array) -> Array:
        """Return the response over noise at points of the frame, (n,).

        Each point has the response of its best scale.
        """
        rows, columns = self.smooth.shape
        places = (points_uv - 0.5 * (self.reduction - 1)) / self.reduction
        u = np.minimum(np.maximum(np.rint(places[:, 0]), 0), columns - 1).astype(np.int64)
        v = np.minimum(np.maximum(np.rint(places[:, 1]), 0), rows - 1).astype(np.int64)
        over_noise: Array = self.best[v, u].astype(np.float64)
        return over_noise


def _half_laplacian(x: Image, sigma: float, out: Image) -> None:
    """Write half the Laplacian of ``x`` times sigma squared, and 0 at the border."""
    columns = x.shape[1]
    flat = x.reshape(-1)
    middle = slice(columns, flat.size - columns)
    _sum_round(
        flat[: middle.stop - columns], flat[columns - 1 : middle.stop - 1], flat[middle], flat[columns + 1 : middle.stop + 1],
        flat[2 * columns :], np.float32(0.5 * sigma**2), out.reshape(-1)[middle],
    )  # fmt: skip
    out[0] = out[-1] = out[:, 0] = out[:, -1] = 0


def _noise_of(reduced: Image, inside: BoolArray, factor: int) -> float:
    """Return the noise of a pixel of an image.

    The image is ``factor`` times smaller than the field.
    """
    rows, columns = reduced.shape
    return pixel_noise(reduced, inside[::factor, ::factor][:rows, :columns])


@kernel("f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4, f4[::1]")
def _sum_round(up, left, centre, right, down, weight, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    four = np.float32(4)
    for i in range(out.size):
        out[i] = weight * (up[i] + down[i] + left[i] + right[i] - four * centre[i])


def _apart(places: Array, distance: float) -> BoolArray:
    """Return which places lie farther than ``distance`` from all accepted earlier ones, (n,)."""
    keep = np.ones(len(places), np.bool_)
    if len(places) > 1:
        pairs = cKDTree(places).query_pairs(distance, output_type="ndarray")
        for first, second in pairs[np.argsort(pairs[:, 0], kind="stable")].tolist():
            keep[second] &= not keep[first]
    return keep
