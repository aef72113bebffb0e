"""Step 1 of the four-step filter: homomorphic filtering, equation (4)."""

from __future__ import annotations

import math

import numpy as np

from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.segmenter.picture.log_image import Image


def homomorphic(x: Image, low: float = 0.5, high: float = 2.0, slope: float = 1.0, cutoff: float = 8.0) -> Image:
    """Filter a log image by eq. (4) of the paper.

    The filter reduces slow shading and raises detail. The transfer function H(D) = (high - low)(1 - exp(-slope D^2 /
    cutoff^2)) + low, with D in cycles per image width, is ``high`` minus a Gaussian, so that no Fourier transform is
    needed: H applied to x is ``high x - (high - low) G * x`` with the width of :func:`equivalent_sigma`. Edges are
    reflected. (1 - low) times the mean is added, so that H(0) = 1 and the mean level stays. The exponential that ends a
    textbook homomorphic filter is monotone and left out.

    Parameters
    ----------
    x : (rows, columns) float32
        Logarithm of the intensity.
    low, high, slope, cutoff : float
        gamma_L, gamma_H, c and D0 of the paper.

    Returns
    -------
    (rows, columns) float32, log units.
    """
    background = gaussian(x, equivalent_sigma(x.shape[1], slope, cutoff))
    filtered: Image = x * np.float32(high)
    background *= np.float32(high - low)
    filtered -= background
    filtered += np.float32((1.0 - low) * float(x.mean()))
    return filtered


def equivalent_sigma(width: int, slope: float, cutoff: float) -> float:
    """Return the standard deviation in pixels of the Gaussian in equation (4).

    It is N sqrt(c) / (pi sqrt(2) D0), N being the width.
    """
    return width * math.sqrt(slope) / (math.pi * math.sqrt(2.0) * cutoff)
