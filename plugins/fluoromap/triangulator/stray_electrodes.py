"""Stray electrodes: one view took something else for the electrode, and the other electrodes show it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fluoromap.contracts import Array
from fluoromap.triangulator.error_sources import ErrorSource, jacobians, pixel_noise_px2
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels

STRAY_BEYOND_SD = 4.0
_MOST_STRAYS = 0.34
"""Largest share of electrodes that can be strays; more of them mean that something else is wrong."""


def epipolar_rows(cameras: Cameras, points_mm: Array) -> Array:
    """Return the epipolar direction of each electrode's four pixel coordinates, (N, 4 N).

    No displacement of the electrode changes its pixels along that direction. The pixel residual along it is Sampson's
    epipolar distance, px.
    """
    n = len(points_mm)
    across = np.linalg.svd(jacobians(cameras, points_mm).reshape(n, 4, 3))[0][:, :, 3]
    rows = np.zeros((n, n, 4))
    rows[np.arange(n), np.arange(n)] = across
    return rows.reshape(n, 4 * n)


def widen_strays(
    cameras: Cameras, pixels: TwoViewPixels, points_mm: Array, sources: Sequence[ErrorSource]
) -> TwoViewPixels:
    """Widen the pixel covariances of stray electrodes by their misfit.

    A stray is an electrode whose epipolar distance the other electrodes do not predict. Breathing, beats and the gantry
    displace neighbours alike; ``sources`` describe these errors, so that the remaining misfit belongs to the electrode.
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
