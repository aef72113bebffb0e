"""A first overlay that nobody sees: it loads the letters and all else that the first picture of a process waits for."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import ChamberMap, SurfaceSite
from fluoromap.drawing.overlay import Look, draw_overlay
from fluoromap.drawing.png import encode_png
from fluoromap.geometry import Gantry, camera_from_gantry

_RADIUS_MM = 30.0
_PIXELS = 512


def warm_up() -> None:
    """Draw an octahedron with six sites, at both sizes."""
    camera = camera_from_gantry(Gantry(30.0, 10.0, 1000.0, 700.0, (0.3, 0.3), _PIXELS, _PIXELS))
    corners = _RADIUS_MM * np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    sites = tuple(
        SurfaceSite(f"S{number:02}", corner, corner, 0.0, lat_ms, None)
        for number, (corner, lat_ms) in enumerate(
            zip(corners, np.linspace(4.0, 97.0, len(corners)).tolist(), strict=True)
        )
    )
    chamber = ChamberMap(
        vertices_mm=corners, faces=faces, lat_ms=np.array([site.lat_ms for site in sites]), lat_sd_ms=np.ones(6),
        covered=np.ones(6, dtype=np.bool_), sites=sites, earliest=((sites[0].site, 1.0),), total_activation_time_ms=93.0,
        leave_one_out_rms_ms=None, volume_ml=0.0, area_cm2=0.0, coverage=1.0,
    )  # fmt: skip
    frame = np.zeros((_PIXELS, _PIXELS), dtype=np.uint8)
    for scale in (1, 2):
        encode_png(draw_overlay(frame, camera, chamber, np.zeros(3), sites[0].site, None, Look(scale=scale)))
