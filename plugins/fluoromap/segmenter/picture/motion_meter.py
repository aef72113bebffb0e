"""Motion of each frame: the change from the one before."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fluoromap.contracts import BoolArray
from fluoromap.segmenter.picture.gaussian_blur import gaussian, reduce_by
from fluoromap.segmenter.picture.log_image import Image

_SIGMA_PX = 3.0
_REDUCTION = 4
_LIVELY = 0.05


class MotionMeter:
    """RMS difference of each log image to the previous one, where the run moves.

    This is the paper's criterion for the diastolic frame. A Gaussian of sigma 3 px is applied first; otherwise photon
    noise would decide. Only the twentieth of the field that varies most is compared; at most 15 evenly spaced log
    images determine it. The object stores one reduced image.
    """

    def __init__(self, samples: Iterable[Image], inside: BoolArray) -> None:
        small = [_reduced(x) for x in samples]
        field = reduce_by(inside.astype(np.float32), _REDUCTION) > 0.5
        if not field.any():
            field[:] = True
        changing = np.std(small, axis=0)
        self._weights = field & (changing >= np.quantile(changing[field], 1.0 - _LIVELY))
        self._before: Image | None = None

    def __call__(self, x: Image) -> float:
        """Return the motion of the next frame; 0 for the first."""
        small = _reduced(x)
        before, self._before = self._before, small
        if before is None:
            return 0.0
        return float(np.sqrt(np.mean((small - before)[self._weights] ** 2, dtype=np.float64)))


def _reduced(x: Image) -> Image:
    variance = (_SIGMA_PX**2 - (_REDUCTION**2 - 1) / 12.0) / _REDUCTION**2
    # Halved twice, because only halving is compiled.
    return gaussian(reduce_by(reduce_by(x, 2), _REDUCTION // 2), float(np.sqrt(variance)))
