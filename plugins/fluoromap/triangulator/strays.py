"""Electrodes that one view took for something else: told by the others of the same moment, and trusted as little."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fluoromap.contracts import Array
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels
from fluoromap.triangulator.uncertainty import ErrorSource, jacobians, pixel_noise_px2

STRAY_BEYOND_SD = 4.0
_MOST_STRAYS = 0.34
"""Where more electrodes than this share disagree with the rest, it is not they that are wrong."""


def epipolar_rows(cameras: Cameras, points_mm: Array) -> Array:
    """For each electrode the direction of its four pixel coordinates that no displacement of it reaches, (N, 4 N).

    The pixel residual along it is Sampson's epipolar distance, px.
    """
    n = len(points_mm)
    across = np.linalg.svd(jacobians(cameras, points_mm).reshape(n, 4, 3))[0][:, :, 3]
    rows = np.zeros((n, n, 4))
    rows[np.arange(n), np.arange(n)] = across
    return rows.reshape(n, 4 * n)


def strays_doubted(
    cameras: Cameras, pixels: TwoViewPixels, points_mm: Array, sources: Sequence[ErrorSource]
) -> TwoViewPixels:
    """The same pixels; those of an electrode whose epipolar distance the others cannot foretell get a covariance as large
    as that misfit.

    Breathing, beats and the gantry displace neighbours alike, which ``sources`` know: what is left is the electrode's own.
    """
    n = len(points_mm)
    rows = epipolar_rows(cameras, points_mm)
    residuals = rows @ pixels.residuals_px(cameras, points_mm)
    common = sum((source.pixels_px2() for source in sources), np.zeros((4 * n, 4 * n)))
    a, b = (np.array(covariance) for covariance in pixels.covariances)
    for _ in range(int(_MOST_STRAYS * n)):
        weight = np.linalg.inv(rows @ (common + pixel_noise_px2((a, b))) @ rows.T)
        alone = weight @ residuals / np.sqrt(np.diagonal(weight))
        worst = int(np.argmax(np.abs(alone)))
        if abs(alone[worst]) <= STRAY_BEYOND_SD:
            return TwoViewPixels(pixels.labels, pixels.pixels, (a, b))
        misfit_px = float(alone[worst] / np.sqrt(weight[worst, worst]))
        a[worst] += misfit_px**2 * np.eye(2)
        b[worst] += misfit_px**2 * np.eye(2)
    return pixels
