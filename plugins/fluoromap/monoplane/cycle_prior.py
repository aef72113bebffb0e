"""A site's biplane cycle as a smooth closed curve: position, velocity and uncertainty at any phase."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, SiteCycle

_HARMONICS = np.arange(1, 9)
_WIDTHS = (0.25, 0.4, 0.6, 0.9)
_NOISE_RATIOS = np.geomspace(1e-4, 1.0, 9)


@dataclass(frozen=True, eq=False)
class CycleCurve:
    """Positions of m electrodes as a sum of harmonics of the cycle.

    labels : (catheter, electrode). mean_mm : (m, 3). coefficients : (k, m, 3) of constant, cosines and sines.
    covariance : (k, k) of the coefficients of one coordinate, mm^2.
    """

    labels: tuple[tuple[str, int], ...]
    mean_mm: Array
    coefficients: Array
    covariance: Array

    def positions_mm(self, phases: Array) -> Array:
        """Return world positions at phases (n,), shape (n, m, 3)."""
        found: Array = self.mean_mm + np.einsum("nk,kmi->nmi", _waves(phases), self.coefficients)
        return found

    def velocities_mm(self, phases: Array) -> Array:
        """Return derivatives by phase at phases (n,), mm a cycle, shape (n, m, 3)."""
        found: Array = np.einsum("nk,kmi->nmi", _wave_slopes(phases), self.coefficients)
        return found

    def sd_mm(self, phases: Array) -> Array:
        """Return the standard deviation (n,) of one coordinate at phases (n,).

        Gaps between the moments and their scatter make it larger.
        """
        waves = _waves(phases)
        found: Array = np.sqrt(np.einsum("nk,kl,nl->n", waves, self.covariance, waves))
        return found


def fit_cycle(cycle: SiteCycle) -> CycleCurve:
    """Fit a cycle's moments by ridge regression on harmonics.

    The expected strength of the harmonics falls with their order. The evidence chooses how fast it falls and how strongly
    the moments scatter, so that a dense cycle is averaged over its beats and a sparse one is not overfitted.
    """
    mean = cycle.positions_mm.mean(axis=0)
    flat = (cycle.positions_mm - mean).reshape(len(cycle.phases), -1)
    best = max(
        (_evidence(_waves(cycle.phases) * _strengths(width), flat, width) for width in _WIDTHS),
        key=lambda found: found[0],
    )
    _, width, ratio, scale = best
    strengths = _strengths(width)
    waves = _waves(cycle.phases) * strengths
    inverse = np.linalg.inv(waves.T @ waves + ratio * np.eye(len(strengths)))
    coefficients = strengths[:, None] * (inverse @ (waves.T @ flat))
    covariance = scale * ratio * strengths[:, None] * inverse * strengths
    return CycleCurve(cycle.labels, mean, coefficients.reshape(-1, *mean.shape), covariance)


def _evidence(waves: Array, flat: Array, width: float) -> tuple[float, float, float, float]:
    """Return the greatest log evidence over the ratio of scatter to motion.

    Returns
    -------
    tuple
        Log evidence, width, ratio of scatter to motion, variance of the motion in mm^2.
    """
    moments, columns = flat.shape
    left, sizes, _ = np.linalg.svd(waves, full_matrices=False)
    shares = ((left.T @ flat) ** 2).sum(axis=1)
    outside = max(float((flat**2).sum() - shares.sum()), 0.0)
    spread = sizes**2 + _NOISE_RATIOS[:, None]
    scale = ((shares / spread).sum(axis=1) + outside / _NOISE_RATIOS) / (moments * columns) + 1e-12
    log_det = np.log(spread).sum(axis=1) + (moments - len(sizes)) * np.log(_NOISE_RATIOS)
    evidence = -0.5 * columns * (moments * np.log(scale) + log_det)
    at = int(np.argmax(evidence))
    return float(evidence[at]), width, float(_NOISE_RATIOS[at]), float(scale[at])


def _strengths(width: float) -> Array:
    """Return the expected size of the constant, the cosines and the sines.

    It falls faster for a larger ``width``.
    """
    falling = np.exp(-0.5 * (width * _HARMONICS) ** 2)
    return np.concatenate([[1.0], falling, falling])


def _waves(phases: Array) -> Array:
    angle = 2 * np.pi * np.asarray(phases)[:, None] * _HARMONICS
    return np.concatenate([np.ones((len(angle), 1)), np.cos(angle), np.sin(angle)], axis=1)


def _wave_slopes(phases: Array) -> Array:
    rate = 2 * np.pi * _HARMONICS
    angle = np.asarray(phases)[:, None] * rate
    return np.concatenate([np.zeros((len(angle), 1)), -rate * np.sin(angle), rate * np.cos(angle)], axis=1)
