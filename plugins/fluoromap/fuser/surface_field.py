"""Activation times over a surface as a Gaussian process along it, averaged over its length and amplitude.

The covariance is Matern 3/2 built from eigenfunctions of the surface's Laplace-Beltrami operator, so that distance counts
along the wall and not through the cavity. Coveney et al., "Gaussian process manifold interpolation for probabilistic atrial
activation maps and uncertain conduction velocity", Phil. Trans. R. Soc. A 378 (2020) 20190345. The mean is a plane
wave with a wide prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import eigsh
from scipy.special import logsumexp

from fluoromap.contracts import Array, IntArray
from fluoromap.fuser.surface import SurfacePoints, face_areas_mm2

LENGTHS_MM = (8.0, 12.0, 18.0, 27.0, 40.0, 60.0)
AMPLITUDES_MS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
# Conduction of 0.5 to 1 m/s over chambers of 3 to 8 cm gives bumps of this length and height; the priors are wide.
LENGTH_PRIOR = (25.0, 0.6)
AMPLITUDE_PRIOR = (12.0, 1.2)
LEVEL_SD_MS = 200.0
SLOPE_SD_MS_PER_MM = 1.0
LEAST_SD_MS = 0.41
"""Error of a difference of two times read at 1000 samples/s: sqrt(2/12) ms. No activation time is better than that."""


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """What the other sites say about each site: predicted_ms (k,) and sd_ms (k,), that of the measurement included."""

    predicted_ms: Array
    sd_ms: Array


class SurfaceField:
    """Prior of activation times on one surface, and what measurements make of it.

    Parameters
    ----------
    vertices_mm, faces : (n, 3), (f, 3)
        A closed surface with edges well below the shortest length of 8 mm.
    """

    def __init__(self, vertices_mm: Array, faces: IntArray) -> None:
        self._faces = faces
        area = float(face_areas_mm2(vertices_mm, faces).sum())
        # Weyl's law: about area * lambda / 4 pi eigenvalues lie below lambda; 0.13 /mm2 holds waves down to 17 mm.
        modes = int(np.clip(0.13 * area / (4 * np.pi), 30, 250))
        values, self._modes = _laplace_beltrami(vertices_mm, faces, min(modes, len(vertices_mm) // 3))
        self._spectra = []
        for length in LENGTHS_MM:
            # Matern of smoothness 3/2 in two dimensions, scaled to a mean variance of 1 over the surface.
            spectrum = (3 / length**2 + values) ** -2.5
            self._spectra.append(spectrum * area / spectrum.sum())
        centred = vertices_mm - vertices_mm.mean(axis=0)
        self._trend = np.column_stack([np.full(len(centred), LEVEL_SD_MS), SLOPE_SD_MS_PER_MM * centred])

    def estimate(self, points: SurfacePoints, lat_ms: Array, lat_sd_ms: Array) -> tuple[Array, Array]:
        """Posterior mean and standard deviation (n,), (n,) in ms at the vertices, from k measured points."""
        rows, level = self._rows(points), float(np.median(lat_ms))
        grid = self._grid(rows, lat_ms - level, lat_sd_ms)
        weights = _normalised([entry.evidence for entry in grid])
        at_sites, trend_at_sites = rows @ self._modes, rows @ self._trend
        mean, square = np.zeros(len(self._modes)), np.zeros(len(self._modes))
        trend_covariance = self._trend @ trend_at_sites.T
        trend_variance = (self._trend**2).sum(axis=1)
        for index, spectrum in enumerate(self._spectra):
            covariance = (self._modes * spectrum) @ at_sites.T
            variance = self._modes**2 @ spectrum
            for weight, entry in zip(weights, grid, strict=True):
                if entry.length_index != index or weight < 1e-4:
                    continue
                power = entry.amplitude_ms**2
                cross = power * covariance + trend_covariance
                here = cross @ entry.solved
                spread = power * variance + trend_variance - np.einsum("nk,nk->n", cross @ entry.inverse, cross)
                mean += weight * here
                square += weight * (np.maximum(spread, 0.0) + here**2)
        kept = sum(weight for weight in weights if weight >= 1e-4)
        mean, square = mean / kept, square / kept
        return mean + level, np.sqrt(np.maximum(square - mean**2, 0.0))

    def leave_one_out(self, points: SurfacePoints, lat_ms: Array, lat_sd_ms: Array) -> LeaveOneOut:
        """Prediction of each site from all others, length and amplitude judged without it as well.

        Closed form: Rasmussen & Williams, Gaussian Processes for Machine Learning, equations (5.10) to (5.12).
        """
        level = float(np.median(lat_ms))
        grid = self._grid(self._rows(points), lat_ms - level, lat_sd_ms)
        variance = np.array([1 / np.diag(entry.inverse) for entry in grid])
        offset = np.array([entry.solved for entry in grid]) * variance
        own = -0.5 * (np.log(2 * np.pi * variance) + offset**2 / variance)
        evidence = np.array([entry.evidence for entry in grid])[:, None] - own
        weights = np.exp(evidence - logsumexp(evidence, axis=0))
        mean_offset = (weights * offset).sum(axis=0)
        spread = (weights * (variance + offset**2)).sum(axis=0) - mean_offset**2
        return LeaveOneOut(lat_ms - mean_offset, np.sqrt(spread))

    def predict(self, points: SurfacePoints, lat_ms: Array, lat_sd_ms: Array, at: SurfacePoints) -> Array:
        """Posterior mean (m,) in ms at other points."""
        predicted: Array = self._rows(at) @ self.estimate(points, lat_ms, lat_sd_ms)[0]
        return predicted

    def _rows(self, points: SurfacePoints) -> csr_array:
        return points.rows(self._faces, len(self._modes))

    def _grid(self, rows: csr_array, times_ms: Array, sd_ms: Array) -> list[_Fit]:
        at_sites, trend = rows @ self._modes, rows @ self._trend
        fixed = trend @ trend.T + np.diag(np.maximum(sd_ms, LEAST_SD_MS) ** 2)
        fits = []
        for index, (length, spectrum) in enumerate(zip(LENGTHS_MM, self._spectra, strict=True)):
            shape = (at_sites * spectrum) @ at_sites.T
            for amplitude in AMPLITUDES_MS:
                covariance = amplitude**2 * shape + fixed
                inverse = np.linalg.inv(covariance)
                solved = inverse @ times_ms
                _, log_determinant = np.linalg.slogdet(covariance)
                evidence = -0.5 * float(times_ms @ solved + log_determinant + len(times_ms) * np.log(2 * np.pi))
                evidence += _log_prior(length, LENGTH_PRIOR) + _log_prior(amplitude, AMPLITUDE_PRIOR)
                fits.append(_Fit(index, amplitude, (inverse + inverse.T) / 2, solved, evidence))
        return fits


@dataclass(frozen=True, eq=False, slots=True)
class _Fit:
    length_index: int
    amplitude_ms: float
    inverse: Array
    solved: Array
    evidence: float


def _log_prior(value: float, prior: tuple[float, float]) -> float:
    centre, spread = prior
    return -0.5 * float(np.log(value / centre) / spread) ** 2


def _normalised(evidence: list[float]) -> Array:
    values = np.array(evidence)
    weights: Array = np.exp(values - logsumexp(values))
    return weights


def _laplace_beltrami(vertices_mm: Array, faces: IntArray, modes: int) -> tuple[Array, Array]:
    """Lowest eigenvalues (m,) in 1/mm² and eigenfunctions (n, m), of unit square integral, by linear finite elements."""
    n = len(vertices_mm)
    corners = vertices_mm[faces]
    edges = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)
    doubled = 2 * face_areas_mm2(vertices_mm, faces)
    # Needles that a hull of nearly coplanar sites contains would otherwise make the matrix useless.
    doubled = np.maximum(doubled, 1e-3 * (edges**2).sum(axis=2).max(axis=1))
    stiffness = np.einsum("fix,fjx->fij", edges, edges) / (2 * doubled)[:, None, None]
    where = (np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel())
    matrix = coo_array((stiffness.ravel(), where), shape=(n, n)).tocsc()
    mass = np.bincount(faces.ravel(), np.repeat(doubled / 6, 3), minlength=n)
    scale = 1 / np.sqrt(mass)
    symmetric = diags_array(scale) @ matrix @ diags_array(scale)
    # The start vector is given so that the same sites always make the same map.
    values, vectors = eigsh(symmetric.tocsc(), k=modes, sigma=-1e-4, which="LM", v0=np.sqrt(mass))
    order = np.argsort(values)
    return np.maximum(values[order], 0.0), vectors[:, order] * scale[:, None]
