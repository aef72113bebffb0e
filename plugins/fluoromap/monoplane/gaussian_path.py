"""Most probable paths of electrodes under a Gaussian prior, given one view's pixels and the catheters' lengths.

Positions x (n frames, m electrodes, 3) are ``mean + columns @ w + e``. The unit normal coefficients ``w`` (q,) describe all
deviations that last longer than a frame; ``e`` is each frame's own deviation. Given ``w`` the frames are independent, so
that the cost is linear in their number.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, solve_triangular
from scipy.linalg.lapack import dtrtri

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
class WhiteEvidence:
    """The evidence with unit noise, linearised at some positions; each frame's own deviation is integrated out.

    gap : (n, r) difference from the prior mean's prediction. by_position : (n, r, 3 m), by_w : (n, r, q + k) its slopes, before
    any gain. The last k coefficients are the lasting errors of the lengths.
    information : (q + k, q + k), vector : (q + k,) the information on the coefficients.
    """

    gap: Array
    by_position: Array
    by_w: Array
    information: Array
    vector: Array


def whiten(prior: PathPrior, evidence: Evidence, at_mm: Array) -> WhiteEvidence:
    """Linearise the evidence at ``at_mm`` (n, m, 3) and whiten it."""
    linear = _linearise(evidence, at_mm)
    from_mean = (at_mm - prior.mean_mm).reshape(len(at_mm), -1, 1)
    gap = linear.residual[..., None] + linear.slope @ from_mean
    spread = linear.noise + linear.slope @ prior.white_mm2 @ np.swapaxes(linear.slope, 1, 2)
    k, q, positions = len(evidence.lengths.first), len(prior.parts), linear.slope.shape[2]
    lasting = np.zeros((*gap.shape[:2], k))
    lasting[:, gap.shape[1] - k :] = np.diag(evidence.lengths.lasting_sd_mm)
    white = np.linalg.solve(np.linalg.cholesky(spread), np.concatenate([gap, linear.slope, lasting], axis=2))
    gap, by_position = white[:, :, 0], white[:, :, 1 : 1 + positions]
    by_columns = by_position @ prior.columns_mm.reshape(len(at_mm), positions, q)
    # The lengths' lasting errors displace no electrode by themselves.
    by_w = np.concatenate([by_columns, white[:, :, 1 + positions :]], axis=2)
    flat = by_w.reshape(-1, q + k)
    return WhiteEvidence(gap, by_position, by_w, flat.T @ flat, flat.T @ gap.reshape(-1))


def estimate_gains(prior: PathPrior, white: WhiteEvidence, choices: Sequence[Sequence[float]]) -> Array:
    """Estimate the gains (1 + parts,) of greatest marginal likelihood.

    Coordinate ascent chooses among ``choices`` for each part from 1 on. A log-normal prior around 1 with standard deviation
    1.5 keeps a gain near 1 where the view shows nothing about it. The first entry, of the fixed part, is 1.
    """
    parts = prior.parts[prior.parts > 0]
    free = np.zeros(len(white.vector), dtype=np.bool_)
    free[: len(prior.parts)] = prior.parts > 0
    information, vector = _without_fixed(free, white.information, white.vector)

    @functools.cache
    def likelihood(*trial: float) -> float:
        scale = np.sqrt(trial)[parts]
        whole = information * np.outer(scale, scale)
        whole.flat[:: len(scale) + 1] += 1.0
        factor = np.linalg.cholesky(whole)
        explained = solve_triangular(factor, scale * vector, lower=True, check_finite=False)
        penalty = (np.log(trial) ** 2).sum() / _GAIN_PRIOR_SD**2
        return float(0.5 * explained @ explained - np.log(np.diag(factor)).sum() - 0.5 * penalty)

    gains = [1.0] * (1 + len(choices))
    for _ in range(2):
        before = gains
        for part, values in enumerate(choices, start=1):
            for value in values:
                trial = [*gains[:part], value, *gains[part + 1 :]]
                if likelihood(*trial) > likelihood(*gains):
                    gains = trial
        if gains is before:
            break
    return np.array(gains)


def _without_fixed(free: BoolArray, information: Array, vector: Array) -> tuple[Array, Array]:
    """Return the information on the ``free`` coefficients alone.

    free : (q,). The others are integrated out, with their unit prior.
    """
    fixed = information[np.ix_(~free, ~free)] + np.eye(int((~free).sum()))
    factor = np.linalg.cholesky(fixed)
    beside = solve_triangular(factor, information[np.ix_(~free, free)], lower=True, check_finite=False)
    explained = solve_triangular(factor, vector[~free], lower=True, check_finite=False)
    return information[np.ix_(free, free)] - beside.T @ beside, vector[free] - beside.T @ explained


@dataclass(frozen=True, eq=False)
class Paths:
    """Most probable positions (n, m, 3), mm, and the joint covariance (n, 3 m, 3 m) of each frame's electrodes, mm^2."""

    positions_mm: Array
    covariance_mm2: Array


def most_probable(
    prior: PathPrior, evidence: Evidence, gains: Array, start_mm: Array, at_start: WhiteEvidence, steps: int
) -> Paths:
    """Find the most probable paths by Gauss-Newton from ``start_mm``, where ``at_start`` is linearised.

    The covariance is that of the last linearisation.
    """
    n, m = start_mm.shape[:2]
    q = len(prior.parts)
    scale = np.ones(len(at_start.vector))
    scale[:q] = np.sqrt(gains)[prior.parts]
    columns = prior.columns_mm.reshape(n, 3 * m, q)
    positions, white = start_mm, at_start
    for step in range(steps):
        if step:
            white = whiten(prior, evidence, positions)
        factor = np.linalg.cholesky(white.information * np.outer(scale, scale) + np.eye(len(scale)))
        w = scale * cho_solve((factor, True), scale * white.vector, check_finite=False)
        share = prior.white_mm2 @ np.swapaxes(white.by_position, 1, 2)
        moved = columns @ w[:q] + (share @ (white.gap - white.by_w @ w)[..., None])[..., 0]
        found = prior.mean_mm + moved.reshape(n, m, 3)
        settled = np.abs(found - positions).max() < _SETTLED_MM
        positions = found
        if settled:
            break
    left = -share @ white.by_w
    left[..., :q] += columns
    # The inverse takes half the time of solving for so many columns.
    half = (left.reshape(n * 3 * m, -1) @ (scale[:, None] * dtrtri(factor, lower=1)[0].T)).reshape(n, 3 * m, -1)
    covariance = half @ np.swapaxes(half, 1, 2) + prior.white_mm2 - share @ np.swapaxes(share, 1, 2)
    unseen = (prior.unseen_mm * scale[:q]).reshape(n, 3 * m, q)
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
