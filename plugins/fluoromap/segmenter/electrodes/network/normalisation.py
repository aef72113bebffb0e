"""The picture as the network sees it: local mean 0, local spread about 1."""

from __future__ import annotations

import numpy as np

from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.segmenter.picture.log_image import Image

_NEIGHBOURHOOD_PX = 16.0
_GLOBAL_SHARE = 0.3
_TINY = 1e-6


def normalise(x: Image) -> Image:
    """Return (x - local mean) / (local spread + 0.3 x overall spread), (rows, columns) float32.

    The neighbourhood is a Gaussian of 16 px, about 5 mm at the network's scale. The overall spread keeps noise small where
    nothing is. Grey levels and log units of any range give the same picture.
    """
    detail = x - gaussian(x, _NEIGHBOURHOOD_PX)
    spread = gaussian(detail * detail, _NEIGHBOURHOOD_PX)
    np.maximum(spread, np.float32(0.0), out=spread)
    overall = float(np.sqrt(spread.mean()))
    np.sqrt(spread, out=spread)
    spread += np.float32(_GLOBAL_SHARE * overall + _TINY)
    detail /= spread
    return detail
