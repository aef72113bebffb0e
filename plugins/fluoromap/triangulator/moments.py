"""Points at many moments of a cycle at once, from the pixels of two views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array
from fluoromap.triangulator.error_sources import ErrorSource, jacobians
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels

STEPS = 8
SETTLED_MM = 1e-6
"""Iteration ends below this step: the next step would be much smaller still."""


@dataclass(frozen=True, eq=False)
class MomentEstimates:
    """Points at p moments and their first-order dependence on the pixels.

    points_mm : (p, N, 3) world. own : (p, N, 3, 4) change of a point with the pixels of the same electrode, mm a pixel.
    shared, row : (p, N, 3), (p, N, 4); a point changes by ``shared`` times the sum over all electrodes of ``row`` times their
    pixels.
    """

    points_mm: Array
    own: Array
    shared: Array
    row: Array

    def covariances_mm2(self, noise_px2: tuple[Array, Array], sources: Sequence[ErrorSource]) -> Array:
        """Return the covariance (p, N, 3, 3) of each point.

        Parameters
        ----------
        noise_px2 : pair of (p, N, 2, 2)
            Covariances in view a and b from errors of each electrode in each view by itself.
        sources : sequence of ErrorSource
            Errors that electrodes share.
        """
        from fluoromap.triangulator.moment_kernel import covariances

        p, n, _ = self.points_mm.shape
        effects = np.concatenate([_of_unit_errors(source) for source in sources], axis=-1).reshape(p, n, 4, -1)
        found: Array = covariances(self.own, self.shared, self.row, np.stack(noise_px2), effects)
        return found


def _of_unit_errors(source: ErrorSource) -> Array:
    """Return the effect (p, 4 N, k) of independent errors of standard deviation 1."""
    covariance = source.covariance
    sds = np.sqrt(np.diagonal(covariance))
    if np.count_nonzero(covariance) <= np.count_nonzero(sds):
        return source.effect_px * sds
    values, axes = np.linalg.eigh(covariance)
    effects: Array = source.effect_px.reshape(-1, len(values)) @ (axes * np.sqrt(np.maximum(values, 0.0)))
    return effects.reshape(source.effect_px.shape)


def _inverse(covariances: Array) -> Array:
    """Return the inverses of matrices (..., 2, 2).

    The general routine takes much longer for thousands of them.
    """
    (a, b), (c, d) = np.moveaxis(covariances, (-2, -1), (0, 1))
    determinant = a * d - b * c
    if not determinant.all():
        raise np.linalg.LinAlgError("a covariance of pixels is singular")
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    inverse: Array = adjugate / determinant[..., None, None]
    return inverse


def separate_moments(cameras: Cameras, points_mm: Array) -> MomentEstimates:
    """Return points (p, N, 3) with the gain of unweighted least squares, each electrode separately."""
    p, n, _ = points_mm.shape
    own: Array = np.asarray(np.linalg.pinv(jacobians(cameras, points_mm).reshape(p, n, 4, 3)), dtype=np.float64)
    return MomentEstimates(points_mm, own, np.zeros((p, n, 3)), np.zeros((p, n, 4)))


def compile_kernels() -> None:
    """Compile the least squares, so that the first study does not wait."""
    from fluoromap.triangulator.moment_kernel import covariances, step

    own, shared, row = np.zeros((1, 1, 3, 4)), np.zeros((1, 1, 3)), np.zeros((1, 1, 4))
    pixels, unit = np.zeros((2, 1, 1, 2)), np.broadcast_to(np.eye(2), (2, 1, 1, 2, 2)).copy()
    matrices = np.stack([np.eye(3, 4), np.eye(3, 4)[[2, 0, 1]]])
    step(matrices, np.ones((1, 1, 3)), pixels, unit, np.zeros((1, 1, 2, 2)), 1.0, own, shared, row)
    covariances(own, shared, row, unit, np.zeros((1, 1, 4, 1)))


def joint_moments(cameras: Cameras, pixels: TwoViewPixels, start_mm: Array, breathing: ErrorSource) -> MomentEstimates:
    """Estimate points by generalised least squares of all electrodes of a moment together.

    Parameters
    ----------
    start_mm : (p, N, 3)
        World.
    breathing : ErrorSource
        The displacement of the whole heart between the runs, one parameter.
    """
    from fluoromap.triangulator.moment_kernel import step

    p, n, _ = start_mm.shape
    matrices = np.stack([camera.matrix for camera in cameras])
    stacked, weights = np.stack(pixels.pixels), _inverse(np.stack(pixels.covariances))
    common = np.ascontiguousarray(breathing.effect_px).reshape(p, n, 2, 2)
    points = np.array(start_mm, order="C")
    own, shared, row = np.empty((p, n, 3, 4)), np.empty((p, n, 3)), np.empty((p, n, 4))
    for _ in range(STEPS):
        if (
            step(matrices, points, stacked, weights, common, float(breathing.covariance[0, 0]), own, shared, row)
            < SETTLED_MM
        ):
            break
    return MomentEstimates(points, own, shared, row)
