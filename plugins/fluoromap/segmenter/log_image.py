"""Stored pixels -> logarithm of the detected intensity, in which attenuations add."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fluoromap.contracts import BoolArray, PixelFacts

Image = NDArray[np.float32]

_FINE_BITS = 10
_COARSE_OFFSET = 0.02
_GAUSSIAN_SD = 1.4826


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _look_up(pixels, table, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    last = table.size - 1
    for v in range(pixels.shape[0]):
        for u in range(pixels.shape[1]):
            out[v, u] = table[min(np.int64(pixels[v, u]), last)]


def central_range(x: Image, inside: BoolArray) -> tuple[float, float] | None:
    """0.5th and 99.5th percentile (nearest rank) of every fourth row and column inside the mask; None where there is
    nothing, or nothing but one value."""
    values = x[::4, ::4][inside[::4, ::4]]
    if values.size < 2:
        return None
    ranks = [round(share * (values.size - 1)) for share in (0.005, 0.995)]
    low, high = np.partition(values, ranks)[ranks].tolist()
    return (low, high) if high > low else None


def pixel_noise(half: Image, inside: BoolArray) -> float:
    """Standard deviation of a pixel of the log image at half its size, from noise: of differences between neighbours."""
    differences = (half[::4, 1::2] - half[::4, :-1:2])[inside[::4, 1::2]]
    return robust_sd(differences) / math.sqrt(2.0)


def robust_sd(values: Image) -> float:
    """Standard deviation of values about 0, from the median of their sizes; 1e-6 at least."""
    if not values.size:
        return 1e-6
    middle = values.size // 2
    return max(_GAUSSIAN_SD * float(np.partition(np.abs(values), middle)[middle]), 1e-6)


@dataclass(frozen=True, slots=True, eq=False)
class LogTransform:
    """The map from stored grey levels to log units that one run needs; dark stays low.

    offset : grey levels added before the logarithm. highest : the grey level MONOCHROME1 is mirrored at, else None.
    table : float32, the answer for each grey level.
    """

    offset: float
    highest: int | None
    logarithmic: bool
    table: Image

    @classmethod
    def of_run(cls, facts: PixelFacts, mean_level: float) -> LogTransform:
        """Choose offset and table from what the header says and from the run's mean grey level (stored pixels).

        Up to 9 bits the offset is 2 % of the mean: one grey level would blow up the noise of dark regions.
        """
        highest = 2**facts.bits_stored - 1 if facts.monochrome1 else None
        level = mean_level if highest is None else highest - mean_level
        offset = 1.0 if facts.bits_stored >= _FINE_BITS else max(1.0, _COARSE_OFFSET * level)
        levels = np.arange(256 if facts.bits_stored <= 8 else 65536, dtype=np.float64)
        table = _transform(levels, offset, highest, facts.logarithmic).astype(np.float32)
        return cls(offset, highest, facts.logarithmic, table)

    def __call__(self, pixels: NDArray[np.generic]) -> Image:
        """Log image of one frame, shape (rows, columns). Means of frames (floating point) are taken exactly."""
        if pixels.dtype.kind == "u":
            out = np.empty(pixels.shape, np.float32)
            _look_up(pixels, self.table, out)
            return out
        exact = _transform(pixels.astype(np.float64), self.offset, self.highest, self.logarithmic)
        return exact.astype(np.float32)


def _transform(
    levels: NDArray[np.float64], offset: float, highest: int | None, logarithmic: bool
) -> NDArray[np.float64]:
    upright = levels if highest is None else np.maximum(highest - levels, 0.0)
    return upright if logarithmic else np.log(upright + offset)
