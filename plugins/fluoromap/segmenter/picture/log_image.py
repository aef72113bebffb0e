"""Log images: the logarithm of the detected intensity, in which attenuations add."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import BoolArray, PixelFacts
from fluoromap.segmenter.kernels import kernel

Image = NDArray[np.float32]

_FINE_BITS = 10
_COARSE_OFFSET = 0.02
_GAUSSIAN_SD = 1.4826


@kernel("u2[:,::1], f4[::1], f4[:,::1]")
def _look_up(pixels, table, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    last = table.size - 1
    for v in range(pixels.shape[0]):
        for u in range(pixels.shape[1]):
            out[v, u] = table[min(np.int64(pixels[v, u]), last)]


def central_range(x: Image, inside: BoolArray) -> tuple[float, float] | None:
    """Return the 0.5th and 99.5th percentile inside the mask.

    Every fourth row and column is used; the percentiles are of nearest rank. None for a constant image.
    """
    values = x[::4, ::4][inside[::4, ::4]]
    if values.size < 2:
        return None
    ranks = [round(share * (values.size - 1)) for share in (0.005, 0.995)]
    low, high = np.partition(values, ranks)[ranks].tolist()
    return (low, high) if high > low else None


def pixel_noise(half: Image, inside: BoolArray) -> float:
    """Return the noise of a pixel of the half-size log image.

    The result is a standard deviation, from differences between neighbours.
    """
    differences = (half[::4, 1::2] - half[::4, :-1:2])[inside[::4, 1::2]]
    return robust_sd(differences) / math.sqrt(2.0)


def robust_sd(values: Image) -> float:
    """Return the standard deviation of values about 0.

    It follows from their median size, and is at least 1e-6.
    """
    if not values.size:
        return 1e-6
    middle = values.size // 2
    return max(_GAUSSIAN_SD * float(np.partition(np.abs(values), middle)[middle]), 1e-6)


@dataclass(frozen=True, slots=True, eq=False)
class LogTransform:
    """The map from stored grey levels to log units for one run.

    Dark stays low.
    offset : grey levels that are added before the logarithm.
    highest : the grey level at which MONOCHROME1 is mirrored, else None.
    table : float32, the log value of each grey level.
    """

    offset: float
    highest: int | None
    logarithmic: bool
    table: Image

    @classmethod
    def of_run(cls, facts: PixelFacts, mean_level: float) -> LogTransform:
        """Choose offset and table from the header and the mean grey level.

        The mean is in stored pixels. For up to 9 bits the offset is 2 % of the mean: an offset of one grey level would
        amplify the noise of dark regions.
        """
        highest = 2**facts.bits_stored - 1 if facts.monochrome1 else None
        level = mean_level if highest is None else highest - mean_level
        offset = 1.0 if facts.bits_stored >= _FINE_BITS else max(1.0, _COARSE_OFFSET * level)
        levels = np.arange(256 if facts.bits_stored <= 8 else 65536, dtype=np.float64)
        table = _transform(levels, offset, highest, facts.logarithmic).astype(np.float32)
        return cls(offset, highest, facts.logarithmic, table)

    def __call__(self, pixels: NDArray[np.generic]) -> Image:
        """Return the log image of one frame, shape (rows, columns).

        Means of frames (floating point) are transformed without the table.
        """
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
