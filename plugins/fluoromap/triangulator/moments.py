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
        p, n, _ = self.points_mm.shape
        effects = np.concatenate([_of_unit_errors(source) for source in sources], axis=-1).reshape(p, n, 4, -1)
        together = np.einsum("pnc,pnck->pk", self.row, effects)
        moved = self.own @ effects + self.shared[..., None] * together[:, None, None]
        noise = _both_views(noise_px2)
        noisy = self.own @ noise
        mixed = (noisy @ self.row[..., None]) * self.shared[..., None, :]
        variance = np.einsum("pna,pnab,pnb->p", self.row, noise, self.row, optimize=True)
        common = variance[:, None, None, None] * self.shared[..., :, None] * self.shared[..., None, :]
        parts = (noisy @ np.swapaxes(self.own, -1, -2), moved @ np.swapaxes(moved, -1, -2), mixed, common)
        found: Array = sum(parts) + np.swapaxes(mixed, -1, -2)
        return (found + np.swapaxes(found, -1, -2)) / 2


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


def joint_moments(cameras: Cameras, pixels: TwoViewPixels, start_mm: Array, breathing: ErrorSource) -> MomentEstimates:
    """Estimate points by generalised least squares of all electrodes of a moment together.

    Pixel noise is independent from electrode to electrode, and one displacement of the whole heart between the runs is common to
    all. So the normal equations are blocks of 3 x 3 and a matrix of rank one, and no large matrix is inverted.

    Parameters
    ----------
    start_mm : (p, N, 3)
        World.
    breathing : ErrorSource
        The displacement of the whole heart between the runs, one parameter.
    """
    p, n, _ = start_mm.shape
    weights = _both_views([_inverse(covariance) for covariance in pixels.covariances])
    common = breathing.effect_px.reshape(p, n, 4, 1)
    pushed = weights @ common
    variance = float(breathing.covariance[0, 0])
    left = variance / (1.0 + variance * (pushed * common).sum(axis=(1, 2, 3)))
    points = start_mm
    for _ in range(STEPS):
        residual = pixels.residuals_px(cameras, points).reshape(p, n, 4)
        jacobian = jacobians(cameras, points).reshape(p, n, 4, 3)
        weighted = np.swapaxes(jacobian, -1, -2) @ np.concatenate([weights, pushed], axis=-1)
        solved = np.linalg.solve(weighted[..., :4] @ jacobian, weighted)
        own, along, pulled = solved[..., :4], solved[..., 4], weighted[..., 4]
        steps = (own @ residual[..., None])[..., 0]
        gain = left / (1.0 - left * (along * pulled).sum(axis=(1, 2)))
        shared = along * gain[:, None, None]
        rest = (steps * pulled).sum(axis=(1, 2)) - (pushed[..., 0] * residual).sum(axis=(1, 2))
        moved = steps + shared * rest[:, None, None]
        points = points + moved
        if np.abs(moved).max(initial=0.0) < SETTLED_MM:
            break
    # What an electrode's own place explains of the common displacement.
    row = (np.swapaxes(own, -1, -2) @ pulled[..., None] - pushed)[..., 0]
    return MomentEstimates(points, own, shared, row)


def _both_views(blocks: Sequence[Array]) -> Array:
    """Return matrices (p, N, 4, 4) from those (p, N, 2, 2) of each view."""
    both = np.zeros((*blocks[0].shape[:2], 4, 4))
    both[..., :2, :2], both[..., 2:, 2:] = blocks
    return both
