"""Table 1: the helices through the paper's method, for every start value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, MonoplaneView, Silent
from fluoromap.paper.tables.depth_figures import DepthFigures, depth_figures
from fluoromap.paper.tables.helix import HELICES, HelixName, HelixView, helix_camera, motion_mm
from fluoromap.paper.tables.helix_run import helix_run
from fluoromap.paper.tables.published import DEPTH_STEPS_MM, IMAGES, LATERAL_OFFSETS_MM, table_1
from fluoromap.registry import build_monoplane

_VIEWS: tuple[HelixView, ...] = ("LAT", "AP")


@dataclass(frozen=True, slots=True)
class Table1Row:
    """A row of Table 1.

    fitted : for H77 in the lateral view, with added depths that were fitted to the paper's figures.
    """

    view: HelixView
    helix: HelixName
    dz_mm: int
    images: int
    paper: DepthFigures
    ours: DepthFigures
    fitted: DepthFigures | None


def table1() -> tuple[Table1Row, ...]:
    """Return Table 1 on both helices, without pixel noise.

    Rows are in the paper's order, helix by helix.
    """
    rows = []
    for name, helix in HELICES.items():
        for view in _VIEWS:
            axis = helix_camera(view).axis_world
            points = motion_mm(helix, max(IMAGES))
            ours = _by_images(view, points)
            fitted = {}
            if view == "LAT" and name == "H77":
                fitted = _by_images(view, points + np.array(LATERAL_OFFSETS_MM)[:, None, None] * axis)
            rows += [
                Table1Row(view, name, dz, images, table_1(view, dz, images), ours[dz, images], fitted.get((dz, images)))
                for dz in DEPTH_STEPS_MM
                for images in IMAGES
            ]
    return tuple(rows)


def _by_images(view: HelixView, points_mm: Array) -> dict[tuple[int, int], DepthFigures]:
    """Return the figures for each start value and number of images."""
    camera = helix_camera(view)
    run = helix_run(camera, points_mm, camera.project(points_mm))
    figures = {}
    for dz in DEPTH_STEPS_MM:
        error = _positions_mm(run, dz) - points_mm
        for images in IMAGES:
            figures[dz, images] = depth_figures([error[:images]], [camera.axis_world])
    return figures


def _positions_mm(run: MonoplaneView, dz_mm: int) -> Array:
    return build_monoplane("a-priori-lm", {"depth_step_mm": dz_mm}).track(run, Silent()).positions_mm
