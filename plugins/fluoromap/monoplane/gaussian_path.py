"""Most probable paths of electrodes under a Gaussian prior, given one view's pixels and the catheters' lengths.

Positions x (n frames, m electrodes, 3) are ``mean + columns @ w + e``. The unit normal coefficients ``w`` (q,) describe all
deviations that last longer than a frame; ``e`` is each frame's own deviation. Given ``w`` the frames are independent, so
that the cost is linear in their number.
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
    """Prior of the paths, before the view's pixels are used.

    mean_mm : (n, m, 3). columns_mm : (n, m, 3, q), one for each unit normal coefficient. unseen_mm : (n, m, 3, q) deviations
    along the rays that no view shows: they belong to the covariance alone. parts : (q,) the part of each column; the columns
    of part p > 0 are multiplied by the square root of its gain. causes : (q,) the cause of each column. white_mm2 :
    (n, 3 m, 3 m) covariance of each frame's own deviation.
    """

    mean_mm: Array
    columns_mm: Array
    unseen_mm: Array
    parts: IntArray
    causes: IntArray
    white_mm2: Array

    def variance_mm2(self, gains: Array, parts: Sequence[int], directions: Array) -> Array:
        """Return the prior variance (n, m) along unit directions (n, m, 3), of some parts and the white share."""
        chosen = np.isin(self.parts, parts)
        along = np.einsum("nmi,nmiq->nmq", directions, (self.columns_mm + self.unseen_mm)[..., chosen])
        white = np.einsum("nmi,nmij,nmj->nm", directions, _own_blocks(self.white_mm2), directions)
        variance: Array = (along**2 * gains[self.parts[chosen]]).sum(axis=-1) + white
        return variance


@dataclass(frozen=True, eq=False)
class Lengths:
    """Lengths between electrodes of a catheter.

    first, second : (k,) electrodes. lengths_mm : (n, k). sd_mm : (k,) standard deviation of each frame's own error.
    lasting_sd_mm : (k,) standard deviation of an error that is the same in all frames.
    """

    first: IntArray
    second: IntArray
    lengths_mm: Array
    sd_mm: Array
    lasting_sd_mm: Array


@dataclass(frozen=True, eq=False)
class Evidence:
    """Data of one view: pixels_uv (n, m, 2), covariance_px2 (n, m, 2, 2), used (n, m), and the catheters' lengths."""

    camera: Camera
    pixels_uv: Array
    covariance_px2: Array
    used: BoolArray
    lengths: Lengths


@dataclass(frozen=True, eq=False)
class _Linear:
    """The linearised evidence: residual (n, r), its slope by position (n, r, 3 m) and its noise (n, r, r)."""

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
class _WhiteEvidence:
    """The evidence with unit noise; each frame's own deviation is integrated out.

    gap : (n, r) difference from the prior mean's prediction. by_position : (n, r, 3 m), by_w : (n, r, q + k) its slopes.
    The last k coefficients are the lasting errors of the lengths.
    """

    gap: Array
    by_position: Array
    by_w: Array

    def information(self) -> tuple[Array, Array]:
        """Return the information on ``w``: matrix (q, q) and vector (q,)."""
        flat = self.by_w.reshape(-1, self.by_w.shape[2])
        return flat.T @ flat, flat.T @ self.gap.reshape(-1)


def _with_lengths(columns: Array, lengths: Lengths) -> Array:
    """Return columns (n, 3 m, q + k): the lengths' lasting errors displace no electrode by themselves."""
    none = np.zeros((*columns.shape[:2], len(lengths.first)))
    return np.concatenate([columns, none], axis=2)


def _whiten(evidence: Evidence, prior: PathPrior, columns: Array, positions_mm: Array) -> _WhiteEvidence:
    """Linearise the evidence at ``positions_mm`` and whiten it; ``columns`` (n, 3 m, q + k)."""
    linear = _linearise(evidence, positions_mm)
    from_mean = (positions_mm - prior.mean_mm).reshape(len(columns), -1, 1)
    gap = linear.residual[..., None] + linear.slope @ from_mean
    spread = linear.noise + linear.slope @ prior.white_mm2 @ np.swapaxes(linear.slope, 1, 2)
    whiten = np.linalg.inv(np.linalg.cholesky(spread))
    by_position = whiten @ linear.slope
    by_w = by_position @ columns
    lasting = evidence.lengths.lasting_sd_mm
    if len(lasting):
        by_w[:, :, -len(lasting) :] += whiten[:, :, -len(lasting) :] * lasting
    return _WhiteEvidence((whiten @ gap)[..., 0], by_position, by_w)


def estimate_gains(prior: PathPrior, evidence: Evidence, at_mm: Array, choices: Sequence[Sequence[float]]) -> Array:
    """Estimate the gains (1 + parts,) of greatest marginal likelihood.

    Coordinate ascent chooses among ``choices`` for each part from 1 on. A log-normal prior around 1 with standard deviation
    1.5 keeps a gain near 1 where the view shows nothing about it. The first entry, of the fixed part, is 1.
    """
    columns = _with_lengths(prior.columns_mm.reshape(len(at_mm), -1, len(prior.parts)), evidence.lengths)
    parts = np.concatenate([prior.parts, np.zeros(len(evidence.lengths.first), dtype=np.int64)])
    information, vector = _whiten(evidence, prior, columns, at_mm).information()
    gains = np.ones(1 + len(choices))

    def likelihood(trial: Array) -> float:
        scale = np.sqrt(trial)[parts]
        whole = scale[:, None] * information * scale + np.eye(len(scale))
        factor = cho_factor(whole, lower=True, overwrite_a=True, check_finite=False)
        explained = (scale * vector) @ cho_solve(factor, scale * vector, check_finite=False)
        penalty = (np.log(trial) ** 2).sum() / _GAIN_PRIOR_SD**2
        return float(0.5 * explained - np.log(np.diag(factor[0])).sum() - 0.5 * penalty)

    best = likelihood(gains)
    for _ in range(2):
        before = gains
        for part, values in enumerate(choices, start=1):
            for value in values:
                trial = gains.copy()
                trial[part] = value
                if value != gains[part] and (found := likelihood(trial)) > best:
                    best, gains = found, trial
        if gains is before:
            break
    return gains


@dataclass(frozen=True, eq=False)
class Paths:
    """Most probable positions (n, m, 3), mm, and the joint covariance (n, 3 m, 3 m) of each frame's electrodes, mm^2."""

    positions_mm: Array
    covariance_mm2: Array


def most_probable(prior: PathPrior, evidence: Evidence, gains: Array, start_mm: Array, steps: int) -> Paths:
    """Find the most probable paths by Gauss-Newton from ``start_mm``.

    The covariance is that of the last linearisation.
    """
    n, m = start_mm.shape[:2]
    columns = (prior.columns_mm * np.sqrt(gains)[prior.parts]).reshape(n, 3 * m, -1)
    columns = _with_lengths(columns, evidence.lengths)
    positions = start_mm
    for _ in range(steps):
        white = _whiten(evidence, prior, columns, positions)
        information, vector = white.information()
        factor = np.linalg.cholesky(information + np.eye(len(vector)))
        w = cho_solve((factor, True), vector, check_finite=False)
        share = prior.white_mm2 @ np.swapaxes(white.by_position, 1, 2)
        moved = columns @ w + (share @ (white.gap - white.by_w @ w)[..., None])[..., 0]
        found = prior.mean_mm + moved.reshape(n, m, 3)
        settled = np.abs(found - positions).max() < _SETTLED_MM
        positions = found
        if settled:
            break
    left = (columns - share @ white.by_w).reshape(n * 3 * m, -1)
    half = solve_triangular(factor, left.T, lower=True, check_finite=False).T.reshape(n, 3 * m, -1)
    covariance = half @ np.swapaxes(half, 1, 2) + prior.white_mm2 - share @ np.swapaxes(share, 1, 2)
    unseen = (prior.unseen_mm * np.sqrt(gains)[prior.parts]).reshape(n, 3 * m, -1)
    covariance = covariance + unseen @ np.swapaxes(unseen, 1, 2)
    return Paths(positions, (covariance + np.swapaxes(covariance, 1, 2)) / 2)


def surprise(prior: PathPrior, evidence: Evidence, at_mm: Array) -> Array:
    """Return the distance (n, m) of the pixels from the prior's expectation, in standard deviations.

    The distance is the RMS of both axes, linearised at ``at_mm``; 0 for electrodes that are not used.
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
    """Return the diagonal blocks (n, m, 3, 3) of (n, 3 m, 3 m)."""
    n, m = len(covariance), covariance.shape[1] // 3
    blocks: Array = np.einsum("nmimj->nmij", covariance.reshape(n, m, 3, m, 3))
    return blocks
