"""The helices through ``rigid-pose``: accuracy of one view for a known rigid body."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, MonoplaneView, Silent
from fluoromap.geometry import Camera
from fluoromap.monoplane.body_pose import pose_covariance_mm2
from fluoromap.paper.tables.helix import HELICES, Helix, HelixName, HelixView, helix_camera, motion_mm
from fluoromap.paper.tables.helix_run import helix_run
from fluoromap.paper.tables.published import DEPTH_STEPS_MM
from fluoromap.registry import build_monoplane

NOISE_PX = 0.5
_IMAGES = (3, 6, 30)
_IMAGES_IN_ALL = 60
_SEED = 77


@dataclass(frozen=True, slots=True)
class RigidPoseRow:
    """3D RMS over points and all images but the first, over several runs, and its Cramer-Rao bound.

    start_value_spread_mm : largest difference between the results of the start values dz = 0 and 5 mm, in the first run.
    """

    helix: HelixName
    view: HelixView
    noise_px: float
    images: int
    rms_mm: float
    bound_mm: float
    start_value_spread_mm: float


def rigid_pose_rows() -> Iterator[RigidPoseRow]:
    """Yield rows for both helices and views, without and with pixel noise."""
    rng = np.random.default_rng(_SEED)
    for name, helix in HELICES.items():
        for view in ("LAT", "AP"):
            for images in _IMAGES:
                for noise_px, runs in ((0.0, 1), (NOISE_PX, max(2, _IMAGES_IN_ALL // images))):
                    yield _row(name, helix, view, images, noise_px, runs, rng)


def _row(
    name: HelixName, helix: Helix, view: HelixView, images: int, noise_px: float, runs: int, rng: np.random.Generator
) -> RigidPoseRow:
    camera = helix_camera(view)
    truth = motion_mm(helix, images)
    squares, spread = [], 0.0
    for number in range(runs):
        pixels = camera.project(truth) + noise_px * rng.normal(size=(images, truth.shape[1], 2))
        run = helix_run(camera, truth, pixels, NOISE_PX)
        found = _positions_mm(run, DEPTH_STEPS_MM[0])
        squares.append(((found - truth)[1:] ** 2).sum(axis=2).mean())
        if number == 0:
            spread = float(np.abs(found - _positions_mm(run, DEPTH_STEPS_MM[-1])).max())
    return RigidPoseRow(
        name, view, noise_px, images, float(np.sqrt(np.mean(squares))), _bound_mm(camera, truth[1:], noise_px), spread
    )


def _positions_mm(run: MonoplaneView, dz_mm: int) -> Array:
    return (
        build_monoplane("rigid-pose", {"depth_step_mm": dz_mm, "known_rigid": True}).track(run, Silent()).positions_mm
    )


def _bound_mm(camera: Camera, truth_mm: Array, noise_px: float) -> float:
    """Return the RMS Cramer-Rao bound over points and images.

    It is proportional to the noise.
    """
    m = truth_mm.shape[1]
    one_px = np.broadcast_to(np.eye(2), (m, 2, 2))
    visible = np.ones(m, dtype=np.bool_)
    traces = [
        np.trace(pose_covariance_mm2(camera, points, points.mean(axis=0), one_px, visible), axis1=1, axis2=2)
        for points in truth_mm
    ]
    return noise_px * float(np.sqrt(np.mean(traces)))
