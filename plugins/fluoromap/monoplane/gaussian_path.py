"""Paths of electrodes under a Gaussian prior, and what one view's pixels and the catheters' lengths make of them.

Positions x (n frames, m electrodes, 3) are ``mean + columns @ w + e``: ``w`` (q,) unit normal coefficients of everything that
lasts longer than a frame, ``e`` what each frame has of its own. Everything is solved frame by frame given ``w``, so the
cost is linear in the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.geometry import Camera

_GAIN_PRIOR_SD = 1.5
_UNSEEN_VARIANCE = 1e12
_SETTLED_MM = 0.005


@dataclass(frozen=True, eq=False)
class PathPrior:
    """What is expected of the paths before the view is looked at.

    mean_mm : (n, m, 3). columns_mm : (n, m, 3, q), one for each unit normal coefficient. parts : (q,) the part each column
    belongs to; the columns of part p > 0 are multiplied by the square root of its gain. white_mm2 : (n, 3 m, 3 m) of each
    frame's own share.
    """

    mean_mm: Array
    columns_mm: Array
    parts: IntArray
    white_mm2: Array

    def variance_mm2(self, gains: Array, parts: Sequence[int], directions: Array) -> Array:
        """Prior variance (n, m) along unit directions (n, m, 3), of some parts and the white share."""
        chosen = np.isin(self.parts, parts)
        along = np.einsum("nmi,nmiq->nmq", directions, self.columns_mm[..., chosen])
        white = np.einsum("nmi,nmij,nmj->nm", directions, _own_blocks(self.white_mm2), directions)
        variance: Array = (along**2 * gains[self.parts[chosen]]).sum(axis=-1) + white
        return variance


@dataclass(frozen=True, eq=False)
class Lengths:
    """Distances that a catheter keeps: between electrodes first (k,) and second (k,), mm (n, k), with their sd (k,)."""

    first: IntArray
    second: IntArray
    lengths_mm: Array
    sd_mm: Array


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one view shows. pixels_uv : (n, m, 2), covariance_px2 : (n, m, 2, 2), used : (n, m)."""

    camera: Camera
    pixels_uv: Array
    covariance_px2: Array
    used: BoolArray
    lengths: Lengths


@dataclass(frozen=True, eq=False)
class _Linear:
    """The evidence about ``positions``: residual (n, r), its slope by position (n, r, 3 m) and its noise (n, r, r)."""

    residual: Array
    slope: Array
    noise: Array


def _linearise(evidence: Evidence, positions_mm: Array) -> _Linear:
    n, m = positions_mm.shape[:2]
    lengths = evidence.lengths
    k = len(lengths.first)
    rows = 2 * m + k
    residual, slope, noise = np.zeros((n, rows)), np.zeros((n, rows, m, 3)), np.zeros((n, rows, rows))
    used = evidence.used
    frames, electrodes = np.arange(n)[:, None], np.arange(m)
    off = evidence.pixels_uv - evidence.camera.project(positions_mm)
    residual[:, : 2 * m] = np.where(used[..., None], off, 0.0).reshape(n, 2 * m)
    jacobian = np.where(used[..., None, None], evidence.camera.jacobian(positions_mm), 0.0)
    pixel_noise = np.where(used[..., None, None], evidence.covariance_px2, np.eye(2) * _UNSEEN_VARIANCE)
    for axis in (0, 1):
        slope[frames, 2 * electrodes + axis, electrodes] = jacobian[:, :, axis]
        for other in (0, 1):
            noise[frames, 2 * electrodes + axis, 2 * electrodes + other] = pixel_noise[:, :, axis, other]
    if k:
        apart = positions_mm[:, lengths.first] - positions_mm[:, lengths.second]
        distance = np.maximum(np.linalg.norm(apart, axis=2), 1e-6)
        direction = apart / distance[..., None]
        row = 2 * m + np.arange(k)
        residual[:, row] = lengths.lengths_mm - distance
        slope[frames, row, lengths.first] = direction
        slope[frames, row, lengths.second] = -direction
        noise[:, row, row] = lengths.sd_mm**2
    return _Linear(residual, slope.reshape(n, rows, 3 * m), noise)


@dataclass(frozen=True, eq=False)
class _Whitened:
    """The evidence with unit noise, each frame's own share integrated out.

    gap : (n, r) from what the prior's mean foretells. by_position : (n, r, 3 m) and by_w : (n, r, q) its slopes.
    """

    gap: Array
    by_position: Array
    by_w: Array

    def information(self) -> tuple[Array, Array]:
        """Of ``w``: matrix (q, q) and vector (q,)."""
        flat = self.by_w.reshape(-1, self.by_w.shape[2])
        return flat.T @ flat, flat.T @ self.gap.reshape(-1)


def _whitened(evidence: Evidence, prior: PathPrior, columns: Array, positions_mm: Array) -> _Whitened:
    """Linearised at ``positions_mm``; ``columns`` (n, 3 m, q)."""
    linear = _linearise(evidence, positions_mm)
    from_mean = (positions_mm - prior.mean_mm).reshape(len(columns), -1, 1)
    gap = linear.residual[..., None] + linear.slope @ from_mean
    spread = linear.noise + linear.slope @ prior.white_mm2 @ np.swapaxes(linear.slope, 1, 2)
    whiten = np.linalg.inv(np.linalg.cholesky(spread))
    by_position = whiten @ linear.slope
    return _Whitened((whiten @ gap)[..., 0], by_position, by_position @ columns)


def estimate_gains(prior: PathPrior, evidence: Evidence, at_mm: Array, choices: Sequence[Sequence[float]]) -> Array:
    """Gains (1 + parts,) of greatest marginal likelihood, by coordinate ascent over ``choices`` of each part from 1 on.

    A log-normal prior round 1, 1.5 standard deviation, keeps them where the view says nothing. The first entry, of the
    fixed part, is 1.
    """
    columns = prior.columns_mm.reshape(len(at_mm), -1, len(prior.parts))
    information, vector = _whitened(evidence, prior, columns, at_mm).information()
    gains = np.ones(1 + len(choices))

    def likelihood(tried: Array) -> float:
        scale = np.sqrt(tried)[prior.parts]
        whole = scale[:, None] * information * scale + np.eye(len(scale))
        factor = cho_factor(whole, lower=True, overwrite_a=True, check_finite=False)
        explained = (scale * vector) @ cho_solve(factor, scale * vector, check_finite=False)
        penalty = (np.log(tried) ** 2).sum() / _GAIN_PRIOR_SD**2
        return float(0.5 * explained - np.log(np.diag(factor[0])).sum() - 0.5 * penalty)

    best = likelihood(gains)
    for _ in range(2):
        before = gains
        for part, values in enumerate(choices, start=1):
            for value in values:
                tried = gains.copy()
                tried[part] = value
                if value != gains[part] and (found := likelihood(tried)) > best:
                    best, gains = found, tried
        if gains is before:
            break
    return gains


@dataclass(frozen=True, eq=False)
class Paths:
    """Most probable positions (n, m, 3) and the joint covariance (n, 3 m, 3 m) of each frame's electrodes, mm^2."""

    positions_mm: Array
    covariance_mm2: Array


def most_probable(prior: PathPrior, evidence: Evidence, gains: Array, start_mm: Array, steps: int) -> Paths:
    """Maximum a posteriori by Gauss-Newton from ``start_mm`` on, with the covariance of the last linearisation."""
    n, m = start_mm.shape[:2]
    columns = (prior.columns_mm * np.sqrt(gains)[prior.parts]).reshape(n, 3 * m, -1)
    positions = start_mm
    for _ in range(steps):
        seen = _whitened(evidence, prior, columns, positions)
        information, vector = seen.information()
        factor = np.linalg.cholesky(information + np.eye(len(vector)))
        w = cho_solve((factor, True), vector, check_finite=False)
        share = prior.white_mm2 @ np.swapaxes(seen.by_position, 1, 2)
        moved = columns @ w + (share @ (seen.gap - seen.by_w @ w)[..., None])[..., 0]
        found = prior.mean_mm + moved.reshape(n, m, 3)
        settled = np.abs(found - positions).max() < _SETTLED_MM
        positions = found
        if settled:
            break
    left = (columns - share @ seen.by_w).reshape(n * 3 * m, -1)
    half = solve_triangular(factor, left.T, lower=True, check_finite=False).T.reshape(n, 3 * m, -1)
    covariance = half @ np.swapaxes(half, 1, 2) + prior.white_mm2 - share @ np.swapaxes(share, 1, 2)
    return Paths(positions, (covariance + np.swapaxes(covariance, 1, 2)) / 2)


def surprise(prior: PathPrior, evidence: Evidence, at_mm: Array) -> Array:
    """How far the pixels (n, m) lie from where the prior expects them, in its standard deviations (RMS of both axes).

    Linearised at ``at_mm``; 0 for electrodes that are not used.
    """
    jacobian = evidence.camera.jacobian(at_mm)
    by_w = np.einsum("nmki,nmiq->nmkq", jacobian, prior.columns_mm)
    own = _own_blocks(prior.white_mm2)
    spread = by_w @ np.swapaxes(by_w, -1, -2) + jacobian @ own @ np.swapaxes(jacobian, -1, -2) + evidence.covariance_px2
    off = evidence.pixels_uv - evidence.camera.project(at_mm)
    off = off - np.einsum("nmki,nmi->nmk", jacobian, prior.mean_mm - at_mm)
    squared = np.einsum("nmk,nmk->nm", off, np.linalg.solve(spread, off[..., None])[..., 0]) / 2
    found: Array = np.where(evidence.used, np.sqrt(np.maximum(squared, 0.0)), 0.0)
    return found


def _own_blocks(covariance: Array) -> Array:
    """The (n, m, 3, 3) blocks on the diagonal of (n, 3 m, 3 m)."""
    n, m = len(covariance), covariance.shape[1] // 3
    blocks: Array = np.einsum("nmimj->nmij", covariance.reshape(n, m, 3, m, 3))
    return blocks
