"""A first overlay that nobody sees: it loads the letters and all else that the first picture of a process waits for."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import ChamberMap, SurfaceSite
from fluoromap.drawing.overlay import Look, draw_overlay
from fluoromap.drawing.png import encode_png
from fluoromap.geometry import Gantry, camera_from_gantry

_RADIUS_MM = 30.0
_PIXELS = 512
_TIMES_MS = np.arange(-60.0, 181.0)
"""The times of most maps, in whole ms as the labels show them: the letters of a label are drawn once in a process."""


def warm_up() -> None:
    """Draw an octahedron with many sites, at both sizes.

    Each site has another of the times that labels show.
    """
    camera = camera_from_gantry(Gantry(30.0, 10.0, 1000.0, 700.0, (0.3, 0.3), _PIXELS, _PIXELS))
    corners = _RADIUS_MM * np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    sites = tuple(
        SurfaceSite(f"S{number:03}", corners[number % 6], corners[number % 6], 0.0, lat_ms, None)
        for number, lat_ms in enumerate(_TIMES_MS.tolist())
    )
    chamber = ChamberMap(
        vertices_mm=corners, faces=faces, lat_ms=np.linspace(4.0, 97.0, 6), lat_sd_ms=np.ones(6),
        covered=np.ones(6, dtype=np.bool_), sites=sites, earliest=((sites[0].site, 1.0),), total_activation_time_ms=93.0,
        leave_one_out_rms_ms=None, volume_ml=0.0, area_cm2=0.0, coverage=1.0,
    )  # fmt: skip
    frame = np.zeros((_PIXELS, _PIXELS), dtype=np.uint8)
    for scale in (1, 2):
        encode_png(draw_overlay(frame, camera, chamber, np.zeros(3), sites[0].site, None, Look(scale=scale)))
