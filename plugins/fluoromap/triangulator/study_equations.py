"""Linear equations of a study for its gantry's errors and its catheters' gaps, and their evidence.

Each site gives ``r = S g + E gamma + e``: r are its epipolar distances (px) and electrode gaps (mm), g the gantry's errors,
gamma the errors of the catalogue's gaps, and e pixel noise, breathing and beats. g and gamma are the same at all sites.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array
from fluoromap.triangulator.estimate import separate_gain, triangulate_unweighted
from fluoromap.triangulator.spacing import neighbours
from fluoromap.triangulator.stray_electrodes import epipolar_rows
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels
from fluoromap.triangulator.uncertainty import (
    ErrorSource,
    UncertaintyParams,
    beat_sources,
    bend_covariances_px2,
    breathing_effect_px,
    breathing_sources,
    gantry_effect_px,
    jacobians,
    pixel_noise_px2,
)

GANTRY_UNKNOWNS = 14
GAP_SD_MM = 0.3
"""Error of a catalogue's gap, the same at all sites: bent shafts, tip centres, wrong descriptions."""
_SPACING_SD_MM = 0.1
"""Difference of a gap between sites."""
_BREATHING_LOG_SD, _BEATS_LOG_SD = 1.1, 0.7


@dataclass(frozen=True, slots=True)
class HeartScale:
    """A study's breathing and beat variation, as multiples of the parameters' values."""

    breathing: float = 1.0
    beats: float = 1.0

    @property
    def log_prior(self) -> float:
        """Logarithm of the log-normal prior density, up to a constant."""
        return -0.5 * float(
            (np.log(self.breathing) / _BREATHING_LOG_SD) ** 2 + (np.log(self.beats) / _BEATS_LOG_SD) ** 2
        )


HEART_SCALES = tuple(
    HeartScale(breathing, beats)
    for breathing in (0.07, 0.15, 0.3, 0.55, 1.0, 1.6)
    for beats in (0.3, 0.6, 1.0, 1.6, 2.4)
)


@dataclass(frozen=True, eq=False)
class SiteEquations:
    """One site's k equations ``residual = slope x + error`` for the u unknowns x: gantry, then gaps.

    The first ``epipolar`` equations are epipolar distances in px, the others electrode gaps in mm.

    residual : (k,). slope : (k, u). fixed : (k, k) covariance of the error from pixels and from the gaps' scatter.
    breathing, beats : (k, k) covariances from breathing and from beats. breath : (k, 3) effect of breathing, an mm.
    pixel_variance : (epipolar,) px^2.
    """

    residual: Array
    slope: Array
    fixed: Array
    breathing: Array
    beats: Array
    breath: Array
    epipolar: int
    pixel_variance: Array

    def covariance(self, scale: HeartScale) -> Array:
        """Return the covariance (k, k) of the error in a heart of this scale."""
        total: Array = self.fixed + scale.breathing**2 * self.breathing + scale.beats**2 * self.beats
        return total


@dataclass(frozen=True, eq=False)
class Information:
    """All that a study's equations say about the unknowns in a heart of one scale.

    matrix : (u, u). vector : (u,). constant : log likelihood without the unknowns.
    """

    scale: HeartScale
    matrix: Array
    vector: Array
    constant: float

    def posterior(self, prior: Array) -> tuple[Array, Array]:
        """Return covariance (u, u) and mean (u,) of the unknowns."""
        # prior (1 + matrix prior)^-1 needs no inverse of a prior that may be 0.
        covariance: Array = np.asarray(prior @ np.linalg.inv(np.eye(len(prior)) + self.matrix @ prior))
        return covariance, covariance @ self.vector


def gap_labels(catalogue: Catalogue, trusted: frozenset[str]) -> tuple[tuple[str, int, int], ...]:
    """Return the gaps (catheter, electrode, next electrode) of the trusted catheters."""
    return tuple(
        (name, number, number + 1)
        for name in catalogue.names
        if name in trusted
        for number in range(1, catalogue[name].electrodes)
    )


def site_equations(
    cameras: Cameras,
    pixels: TwoViewPixels,
    catalogue: Catalogue,
    gaps: Sequence[tuple[str, int, int]],
    params: UncertaintyParams,
) -> SiteEquations:
    """Return a site's equations: epipolar distances, then those of the ``gaps`` that the site shows."""
    points = triangulate_unweighted(cameras, pixels)
    n = len(points)
    combine = epipolar_rows(cameras, points)
    residual = combine @ pixels.residuals_px(cameras, points)
    known = []
    for i, j, gap in neighbours(pixels.labels, catalogue):
        label = (pixels.labels[i][0], pixels.labels[i][1], pixels.labels[j][1])
        if label in gaps:
            known.append((i, j, gap, list(gaps).index(label)))
    errors = np.zeros((n + len(known), len(gaps)))
    if known:
        first, second = (np.array([row[k] for row in known], dtype=np.intp) for k in (0, 1))
        apart = points[first] - points[second]
        length = np.linalg.norm(apart, axis=1)
        gain = separate_gain(cameras, points).reshape(n, 3, 4 * n)
        lengths = np.einsum("ka,kap->kp", apart / length[:, None], gain[first] - gain[second])
        combine = np.concatenate([combine, lengths])
        residual = np.concatenate([residual, length - [gap for _, _, gap, _ in known]])
        errors[n + np.arange(len(known)), [row[3] for row in known]] = 1.0
    jacobian = jacobians(cameras, points)

    def combined(sources: Sequence[ErrorSource]) -> Array:
        effects = [combine @ source.effect_px for source in sources]
        each = [effect @ source.covariance @ effect.T for source, effect in zip(sources, effects, strict=True)]
        return np.asarray(np.sum(each, axis=0), dtype=np.float64)

    noise = pixel_noise_px2(pixels.covariances)
    # An electrode's own bend is no beat. Where pixels are known well, it would hide how far whole catheters move.
    bend = pixel_noise_px2(bend_covariances_px2(jacobian, params))
    fixed = combine @ (noise + bend) @ combine.T
    fixed[range(n, len(residual)), range(n, len(residual))] += _SPACING_SD_MM**2
    breathing = combined(breathing_sources(jacobian, params))
    beats = combined(beat_sources(jacobian, points, pixels.labels, catalogue, params))
    slope = np.concatenate([combine @ gantry_effect_px(cameras, jacobian, points), errors], axis=1)
    return SiteEquations(
        residual, slope, fixed, breathing, beats, combine @ breathing_effect_px(jacobian), n,
        np.diagonal(combine @ noise @ combine.T)[:n],
    )  # fmt: skip


def information(rows: Sequence[SiteEquations], linearised_at: Array) -> list[Information]:
    """Return what the equations say, for each scale of the heart.

    The equations were linearised at the unknowns ``linearised_at`` (u,).
    """
    u = len(linearised_at)
    matrices, vectors = np.zeros((len(HEART_SCALES), u, u)), np.zeros((len(HEART_SCALES), u))
    constants = np.zeros(len(HEART_SCALES))
    breathing, beats = (np.array([getattr(scale, of) ** 2 for scale in HEART_SCALES]) for of in ("breathing", "beats"))
    for one in rows:
        residual = one.residual + one.slope @ linearised_at
        covariance = one.fixed + breathing[:, None, None] * one.breathing + beats[:, None, None] * one.beats
        factor = np.linalg.cholesky(covariance)
        both = np.linalg.solve(factor, np.column_stack([one.slope, residual]))
        products = np.swapaxes(both, -1, -2) @ both
        matrices += products[:, :-1, :-1]
        vectors += products[:, :-1, -1]
        constants -= 0.5 * products[:, -1, -1] + np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(axis=-1)
    return [
        Information(scale, matrix, vector, float(constant))
        for scale, matrix, vector, constant in zip(HEART_SCALES, matrices, vectors, constants, strict=True)
    ]


def log_evidences(hearts: Sequence[Information], prior: Array) -> Array:
    """Return the log evidence (h,) of each heart, up to a constant.

    The unknowns are drawn from ``prior`` (u, u).
    """
    matrices, vectors = np.array([heart.matrix for heart in hearts]), np.array([heart.vector for heart in hearts])
    each = np.eye(len(prior)) + matrices @ prior
    means = (prior @ np.linalg.solve(each, vectors[..., None]))[..., 0]
    own = np.array([heart.constant + heart.scale.log_prior for heart in hearts])
    # det(1 + prior matrix) = det(1 + matrix prior)
    evidences: Array = own + 0.5 * (vectors * means).sum(axis=1) - 0.5 * np.linalg.slogdet(each)[1]
    return evidences
