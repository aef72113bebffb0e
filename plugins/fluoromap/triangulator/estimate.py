"""Points from the pixels of two views, and how pixel errors propagate to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fluoromap.contracts import Array
from fluoromap.geometry import Camera
from fluoromap.matching.two_view import triangulate_linear
from fluoromap.triangulator.error_sources import ErrorSource, jacobians
from fluoromap.triangulator.moments import SETTLED_MM, STEPS, MomentEstimates, joint_moments, separate_moments
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels


@dataclass(frozen=True, eq=False)
class Estimate:
    """Points and their first-order dependence on the pixels.

    points_mm : (..., N, 3) world. gain : (..., 3 N, 4 N) change of each coordinate with each pixel coordinate, mm a pixel.
    Leading axes are moments.
    """

    points_mm: Array
    gain: Array

    def covariance_mm2(self, pixels_px2: Array) -> Array:
        """Return the joint covariance (..., N, 3, N, 3) of all points, from the pixels' (..., 4 N, 4 N)."""
        covariance = self.gain @ pixels_px2 @ _transposed(self.gain)
        shape = self.points_mm.shape
        symmetric: Array = ((covariance + _transposed(covariance)) / 2).reshape(*shape, *shape[-2:])
        return symmetric


class Method(Protocol):
    """A triangulator's way to find points."""

    @property
    def estimates_breathing(self) -> bool:
        """True where the method estimates a displacement of the whole heart between the runs."""

    def start(self, cameras: Cameras, pixels: TwoViewPixels) -> Array:
        """Return points (N, 3) in the world, mm, each electrode located separately."""

    def estimate(self, cameras: Cameras, pixels: TwoViewPixels, start_mm: Array, errors_px2: Array) -> Estimate:
        """Estimate points with the covariance (4 N, 4 N) that weights the pixels."""

    def estimate_moments(
        self, cameras: Cameras, pixels: TwoViewPixels, start_mm: Array, breathing: ErrorSource
    ) -> MomentEstimates:
        """Estimate points at many moments.

        Their own noise and the displacement of the whole heart between the runs weight the pixels.
        """


class SeparateLeastSquares:
    """The paper's method: algebraic least squares of equations (8), electrode by electrode."""

    estimates_breathing = False

    def start(self, cameras: Cameras, pixels: TwoViewPixels) -> Array:
        return triangulate_linear(*cameras, *pixels.pixels)

    def estimate(self, cameras: Cameras, pixels: TwoViewPixels, start_mm: Array, errors_px2: Array) -> Estimate:
        return Estimate(start_mm, separate_gain(cameras, start_mm))

    def estimate_moments(
        self, cameras: Cameras, pixels: TwoViewPixels, start_mm: Array, breathing: ErrorSource
    ) -> MomentEstimates:
        return separate_moments(cameras, start_mm)


class JointLeastSquares:
    """Generalised least squares of all electrodes of a moment together.

    Breathing displaces all electrodes alike between the runs. The method estimates that from their common misfit and
    removes it.
    """

    estimates_breathing = True

    def start(self, cameras: Cameras, pixels: TwoViewPixels) -> Array:
        return triangulate_maximum_likelihood(*cameras, *pixels.pixels, *pixels.covariances)

    def estimate(self, cameras: Cameras, pixels: TwoViewPixels, start_mm: Array, errors_px2: Array) -> Estimate:
        weight = np.linalg.inv(errors_px2)
        points = start_mm
        for _ in range(STEPS):
            design = _design(cameras, points)
            weighted = _transposed(design) @ weight
            gain: Array = np.asarray(np.linalg.solve(weighted @ design, weighted), dtype=np.float64)
            step = (gain @ pixels.residuals_px(cameras, points)[..., None]).reshape(points.shape)
            points = points + step
            if np.abs(step).max() < SETTLED_MM:
                break
        return Estimate(points, gain)

    def estimate_moments(
        self, cameras: Cameras, pixels: TwoViewPixels, start_mm: Array, breathing: ErrorSource
    ) -> MomentEstimates:
        return joint_moments(cameras, pixels, start_mm, breathing)


def triangulate_unweighted(cameras: Cameras, pixels: TwoViewPixels) -> Array:
    """Return the points (N, 3) of least reprojection error where every pixel counts alike.

    Breathing between the runs displaces such points alike. Weighted points follow the view that knows their pixel better:
    then breathing tears neighbours apart, and their distances are wrong by millimetres.
    """
    alike = np.broadcast_to(np.eye(2), (len(pixels.labels), 2, 2))
    return triangulate_maximum_likelihood(*cameras, *pixels.pixels, alike, alike)


def separate_gain(cameras: Cameras, points_mm: Array) -> Array:
    """Return the gain (..., 3 N, 4 N) of unweighted least squares, each electrode separately."""
    *moments, n, _ = points_mm.shape
    inverse = np.linalg.pinv(jacobians(cameras, points_mm).reshape(*moments, n, 4, 3))
    gain = np.zeros((*moments, n, 3, n, 4))
    for row in range(n):
        gain[..., row, :, row, :] = inverse[..., row, :, :]
    return gain.reshape(*moments, 3 * n, 4 * n)


def _design(cameras: Cameras, points_mm: Array) -> Array:
    """Return d pixels/d points, (..., 4 N, 3 N)."""
    *moments, n, _ = points_mm.shape
    own = jacobians(cameras, points_mm).reshape(*moments, n, 4, 3)
    design = np.zeros((*moments, n, 4, n, 3))
    for row in range(n):
        design[..., row, :, row, :] = own[..., row, :, :]
    return design.reshape(*moments, 4 * n, 3 * n)


def _transposed(matrices: Array) -> Array:
    swapped: Array = np.swapaxes(matrices, -1, -2)
    return swapped


def triangulate_maximum_likelihood(
    camera_a: Camera,
    camera_b: Camera,
    pixels_a: Array,
    pixels_b: Array,
    covariances_a_px2: Array,
    covariances_b_px2: Array,
) -> Array:
    """Return the points of least reprojection error.

    Gauss-Newton steps start at the linear solution; all points move in the same step.

    Parameters
    ----------
    pixels_a, pixels_b : ndarray, shape (N, 2)
        The same N electrodes (u, v) in the two views.
    covariances_a_px2, covariances_b_px2 : ndarray, shape (N, 2, 2)
        Covariances of those pixels.

    Returns
    -------
    ndarray, shape (N, 3)
        World, mm.
    """
    pixels = TwoViewPixels((), (pixels_a[None], pixels_b[None]), (covariances_a_px2[None], covariances_b_px2[None]))
    start = triangulate_linear(camera_a, camera_b, pixels_a, pixels_b)[None]
    still = ErrorSource(np.zeros((1, 4 * len(pixels_a), 1)), np.zeros((1, 1)), ("breathing",))
    found: Array = joint_moments((camera_a, camera_b), pixels, start, still).points_mm[0]
    return found
