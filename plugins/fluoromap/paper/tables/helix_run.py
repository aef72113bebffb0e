"""A moving helix as a solver's input: every point is an electrode."""

from __future__ import annotations

import numpy as np

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import Array, ElectrodePoint, MonoplaneView, NamedChain, Observation
from fluoromap.geometry import Camera

_NAME = "helix"
_FRAME_MS = 1000 / 60
_EXACT_MM = 1e-5


def helix_run(camera: Camera, points_mm: Array, pixels_uv: Array, noise_px: float = 0.5) -> MonoplaneView:
    """Return a run of n images.

    Parameters
    ----------
    points_mm : ndarray, shape (n, m, 3)
        World points; those of the first image are the exact a-priori positions.
    pixels_uv : ndarray, shape (n, m, 2)
        Pixels (u, v) of the points.
    noise_px : float
        Stated standard deviation of the pixels.
    """
    images, m = pixels_uv.shape[:2]
    electrodes = tuple(range(1, m + 1))
    covariance = np.broadcast_to(noise_px**2 * np.eye(2), (m, 2, 2))
    return MonoplaneView(
        site=_NAME,
        view="a",
        camera=camera,
        catalogue=DEFAULT_CATALOGUE,
        frame_times_ms=_FRAME_MS * np.arange(images, dtype=np.float64),
        observations=tuple(
            Observation(image, None, (NamedChain(_NAME, electrodes, pixels_uv[image], covariance),))
            for image in range(images)
        ),
        a_priori=tuple(
            ElectrodePoint(_NAME, k, point, _EXACT_MM**2 * np.eye(3), None, None, (0.0, 0.0), 90.0)
            for k, point in zip(electrodes, points_mm[0], strict=True)
        ),
        a_priori_frame=0,
        cycle=None,
        others=(),
    )
