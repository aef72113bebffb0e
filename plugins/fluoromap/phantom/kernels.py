"""Compiled inner loops: the shadow of a catheter, photon counting and the detector's blur."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri

Image = NDArray[np.float32]

SUPERSAMPLING = 2
WALL = 0.86
"""Inner over outer radius of a platinum ring: a wall of 14 %."""
SOLID_TIP = 0.9
"""Share of metal in an ablation tip."""
_BRAID = 2.0
_EXACT_BELOW = 30.0
_CELLS = 4096


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def add_tube(
    thickness: Image,
    touched: NDArray[np.uint8],
    line: Image,
    bands: Image,
    radius_mm: float,
    solid_tip: bool,
    platinum_per_mm: float,
    shaft: float,
) -> None:
    """Add a catheter's attenuation to ``thickness`` (rows x columns, each pixel SUPERSAMPLING squared samples).

    ``line`` : (k, 5) points of the centre line from the tip on: u, v (pixels), arc length (mm), pixels per mm and 1/sin of
    the angle between shaft and ray. ``bands`` : (electrodes, 2) arc lengths. ``touched`` (rows, columns) is set to 1 where
    attenuation is added. A segment of the line owns the samples between the bisectors at its two ends, so that no sample
    is counted twice in a bend. Bands end perpendicular to the shaft in the image.
    """
    rows, columns = touched.shape
    ss = SUPERSAMPLING
    step = np.float32(1.0 / ss)
    count = line.shape[0]
    outer2 = np.float32(radius_mm * radius_mm)
    radius = np.float32(radius_mm)
    two = np.float32(2.0)
    wall2 = np.float32(WALL * WALL)
    platinum, tip_share, braid = np.float32(platinum_per_mm), np.float32(SOLID_TIP), np.float32(_BRAID)
    solid_shaft = np.float32(shaft / (1.0 + _BRAID * (1.0 - WALL)) / (2.0 * radius_mm))
    for k in range(count - 1):
        u0, v0, u1, v1 = line[k, 0], line[k, 1], line[k + 1, 0], line[k + 1, 1]
        reach = radius * line[k, 3] + np.float32(0.5)
        left, right = min(u0, u1) - reach, max(u0, u1) + reach
        upper, lower = min(v0, v1) - reach, max(v0, v1) + reach
        if right < -0.5 or lower < -0.5 or left > columns - 0.5 or upper > rows - 0.5:
            continue
        before, beyond = max(k - 1, 0), min(k + 2, count - 1)
        du0, dv0 = u1 - line[before, 0], v1 - line[before, 1]
        du1, dv1 = line[beyond, 0] - u0, line[beyond, 1] - v0
        px_per_mm, s0, s1 = line[k, 3], line[k, 2], line[k + 1, 2]
        inv_sin = line[k, 4]
        i_from, i_to = max(math.floor(upper), 0), min(math.ceil(lower), rows - 1)
        j_from, j_to = max(math.floor(left), 0), min(math.ceil(right), columns - 1)
        for i in range(i_from * ss, (i_to + 1) * ss):
            v = (np.float32(i) + np.float32(0.5)) * step - np.float32(0.5)
            for j in range(j_from * ss, (j_to + 1) * ss):
                u = (np.float32(j) + np.float32(0.5)) * step - np.float32(0.5)
                ahead = (u - u0) * du0 + (v - v0) * dv0
                behind = (u - u1) * du1 + (v - v1) * dv1
                if ahead < 0 or behind >= 0:
                    continue
                part = ahead / (ahead - behind)
                qu, qv = u - (u0 + part * (u1 - u0)), v - (v0 + part * (v1 - v0))
                off2 = (qu * qu + qv * qv) / (px_per_mm * px_per_mm)
                along = s0 + part * (s1 - s0)
                edge2 = outer2
                if along < radius:
                    edge2 = outer2 - (radius - along) * (radius - along)
                if off2 >= edge2:
                    continue
                half = math.sqrt(edge2 - off2)
                hollow = math.sqrt(max(wall2 * edge2 - off2, np.float32(0.0)))
                chord = two * half * inv_sin
                shell = two * (half - hollow) * inv_sin
                metal = np.float32(-1.0)
                for e in range(bands.shape[0]):
                    if bands[e, 0] <= along < bands[e, 1]:
                        metal = tip_share * chord if e == 0 and solid_tip else shell
                if metal >= 0:
                    thickness[i, j] += platinum * metal
                else:
                    thickness[i, j] += solid_shaft * (chord + braid * shell)
                touched[i // ss, j // ss] = 1


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def absorb(thickness: Image, touched: NDArray[np.uint8], absorbed: Image, weight: float) -> None:
    """Add ``weight`` times the absorbed share of each touched pixel to ``absorbed``.

    Clear ``thickness`` and ``touched``.
    """
    rows, columns = touched.shape
    ss = SUPERSAMPLING
    share = np.float32(1.0 / (ss * ss))
    w = np.float32(weight)
    for i in range(rows):
        for j in range(columns):
            if touched[i, j] == 0:
                continue
            touched[i, j] = 0
            passed = np.float32(0.0)
            for a in range(i * ss, (i + 1) * ss):
                for b in range(j * ss, (j + 1) * ss):
                    passed += math.exp(-thickness[a, b])
                    thickness[a, b] = 0
            absorbed[i, j] += w * (np.float32(1.0) - passed * share)


@njit(cache=True, nogil=True, inline="always")
def _mix_bits(state: np.uint64) -> np.uint64:
    """Return 64 random bits from a counter (SplitMix64: Steele, Lea and Flood, OOPSLA 2014)."""
    z = state * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", inline="always")
def _normal(bits: np.int64, middle: Image, tail: Image) -> Any:
    """Return a standard normal number from 32 random bits.

    It uses the two tables of :func:`normal_quantiles`.
    """
    cell = bits >> 20
    if cell == 0 or cell == _CELLS - 1:
        within = (bits >> 8) & (_CELLS - 1)
        value = tail[within] + np.float32(bits & 0xFF) * np.float32(2.0**-8) * (tail[within + 1] - tail[within])
        return value if cell == 0 else -value
    part = np.float32(bits & 0xFFFFF) * np.float32(2.0**-20)
    return middle[cell] + part * (middle[cell + 1] - middle[cell])


def normal_quantiles() -> tuple[Image, Image]:
    """Return the normal quantiles at 4096 equal steps, in two tables.

    The first has equal steps of the whole range, the second 4096 equal steps of the lowest of these. Numbers between
    two quantiles are uniform. The variance is correct to 1 part in 10 000, the tail to 5 sigma.
    """
    steps = np.arange(_CELLS + 1) / _CELLS
    tail = ndtri(np.maximum(steps, 0.25 / _CELLS) / _CELLS)
    middle = ndtri(np.clip(steps, 1e-9, 1 - 1e-9))
    return middle.astype(np.float32), tail.astype(np.float32)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def count_photons(
    expected: Image, key: np.uint64, noise: float, middle: Image, tail: Image, photons: Image, electronic: Image
) -> None:
    """Draw Poisson counts of mean ``expected`` plus normal noise, pixel by pixel.

    ``noise`` is the standard deviation of the normal noise. Counts below a mean of 30 come from inversion and are
    exact. Others come from the Cornish-Fisher expansion of the Poisson quantile, which has its mean, variance and
    skewness. A pixel's numbers depend only on ``key`` and its place.
    """
    rows, columns = expected.shape
    one, twelfth, sixth = np.float32(1.0), np.float32(1.0 / 12.0), np.float32(1.0 / 6.0)
    sigma = np.float32(noise)
    for i in range(rows):
        for j in range(columns):
            place = np.uint64(2 * (i * columns + j))
            bits = _mix_bits(key + place)
            electronic[i, j] = sigma * _normal(np.int64(bits & np.uint64(0xFFFFFFFF)), middle, tail)
            mean = expected[i, j]
            if mean < np.float32(_EXACT_BELOW):
                left = np.float64(_mix_bits(key + place + np.uint64(1)) >> np.uint64(11)) * 2.0**-53
                probability = math.exp(-np.float64(mean))
                n = 0
                while left > probability and n < 200:
                    left -= probability
                    n += 1
                    probability *= np.float64(mean) / n
                photons[i, j] = np.float32(n)
            else:
                z = _normal(np.int64(bits >> np.uint64(32)), middle, tail)
                # Rounding adds 1/12 to the variance.
                spread = math.sqrt(mean - twelfth)
                value = mean + spread * z + (z * z - one) * sixth + (z - z * z * z) / (np.float32(72.0) * spread)
                photons[i, j] = math.floor(value + np.float32(0.5))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def read_out(photons: Image, electronic: Image, taps: Image, gain: float, top: int, image: NDArray[np.uint16]) -> None:
    """Blur ``photons`` by ``taps`` in both directions, add ``electronic``, scale and round.

    ``taps`` start at the centre; edges are reflected.
    """
    rows, columns = photons.shape
    reach = taps.shape[0] - 1
    across = np.empty((rows, columns), np.float32)
    padded = np.empty(columns + 2 * reach, np.float32)
    for i in range(rows):
        for j in range(columns):
            padded[reach + j] = photons[i, j]
        for k in range(reach):
            padded[reach - 1 - k] = photons[i, k]
            padded[reach + columns + k] = photons[i, columns - 1 - k]
        for j in range(columns):
            total = taps[0] * padded[reach + j]
            for k in range(1, reach + 1):
                total += taps[k] * (padded[reach + j - k] + padded[reach + j + k])
            across[i, j] = total
    factor = np.float32(gain)
    limit = np.float32(top)
    total_row = np.empty(columns, np.float32)
    for i in range(rows):
        for j in range(columns):
            total_row[j] = taps[0] * across[i, j] + electronic[i, j]
        for k in range(1, reach + 1):
            above, below = i - k, i + k
            above = above if above >= 0 else -1 - above
            below = below if below < rows else 2 * rows - 1 - below
            for j in range(columns):
                total_row[j] += taps[k] * (across[above, j] + across[below, j])
        for j in range(columns):
            image[i, j] = np.uint16(min(max(total_row[j] * factor + np.float32(0.5), np.float32(0.0)), limit))
