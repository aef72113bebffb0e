"""A quantity over a closed surface as a Gaussian process, averaged over its length and amplitude.

The covariance is Matern 3/2 built from eigenfunctions of the surface's Laplace-Beltrami operator, so that distance counts
along the wall and not through the cavity. Coveney et al., "Gaussian process manifold interpolation for probabilistic atrial
activation maps and uncertain conduction velocity", Phil. Trans. R. Soc. A 378 (2020) 20190345. The mean may be a plane
wave with a wide prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.special import logsumexp

from fluoromap.contracts import Array, IntArray
from fluoromap.fuser.laplace_beltrami import eigenfunctions
from fluoromap.fuser.surface import SurfacePoints, face_areas_mm2

LENGTHS_MM = (8.0, 12.0, 18.0, 27.0, 40.0, 60.0)
# Conduction of 0.5 to 1 m/s over chambers of 3 to 8 cm makes variations of this length; the prior is wide.
LENGTH_PRIOR = (25.0, 0.6)
_LEAST_WEIGHT = 1e-4


@dataclass(frozen=True, slots=True)
class FieldPrior:
    """Prior of a quantity, in its own unit.

    amplitudes : candidates of the standard deviation about the mean. amplitude_prior : the most likely amplitude, and its
    spread in logarithms. level_sd, slope_sd_per_mm : standard deviations of the mean's value and slope.
    """

    amplitudes: tuple[float, ...]
    amplitude_prior: tuple[float, float]
    level_sd: float
    slope_sd_per_mm: float


class SurfaceField:
    """The Gaussian process of one surface; :meth:`regress` conditions it on measurements.

    Parameters
    ----------
    vertices_mm, faces : (n, 3), (f, 3)
        A closed surface with edges well below the shortest length of 8 mm.
    """

    def __init__(self, vertices_mm: Array, faces: IntArray) -> None:
        self.faces = faces
        area = float(face_areas_mm2(vertices_mm, faces).sum())
        # Weyl's law: about area * lambda / 4 pi eigenvalues lie below lambda; 0.13 /mm2 holds waves down to 17 mm.
        modes = int(np.clip(0.13 * area / (4 * np.pi), 30, 250))
        values, self.modes = eigenfunctions(vertices_mm, faces, min(modes, len(vertices_mm) // 3))
        self.spectra = []
        for length in LENGTHS_MM:
            # Matern of smoothness 3/2 in two dimensions, scaled to a mean variance of 1 over the surface.
            spectrum = (3 / length**2 + values) ** -2.5
            self.spectra.append(spectrum * area / spectrum.sum())
        centred = vertices_mm - vertices_mm.mean(axis=0)
        self.trend = np.column_stack([np.ones(len(centred)), centred])

    def rows(self, points: SurfacePoints) -> csr_array:
        """Return the sparse (k, n) matrix that interpolates vertex values at the points."""
        return points.rows(self.faces, len(self.modes))

    def regress(self, points: SurfacePoints, values: Array, variance: Array, prior: FieldPrior) -> Regression:
        """Compute the regression on values (k, c) at k points.

        All c quantities have the same prior and variances (k,).
        """
        return Regression(self, points, values, variance, prior)


class Regression:
    """A field conditioned on k measurements; the evidence weights length and amplitude."""

    def __init__(
        self, field: SurfaceField, points: SurfacePoints, values: Array, variance: Array, prior: FieldPrior
    ) -> None:
        self._field, self._values = field, values
        rows = field.rows(points)
        self._at_sites = rows @ field.modes
        scale = np.array([prior.level_sd, *[prior.slope_sd_per_mm] * 3])
        self._trend = field.trend * scale
        self._trend_at_sites = rows @ self._trend
        fixed = self._trend_at_sites @ self._trend_at_sites.T + np.diag(variance)
        self._fits = []
        for index, (length, spectrum) in enumerate(zip(LENGTHS_MM, field.spectra, strict=True)):
            shape = (self._at_sites * spectrum) @ self._at_sites.T
            for amplitude in prior.amplitudes:
                covariance = amplitude**2 * shape + fixed
                inverse = np.linalg.inv(covariance)
                solved = inverse @ values
                _, log_determinant = np.linalg.slogdet(covariance)
                evidence = -0.5 * float((values * solved).sum() + values.shape[1] * log_determinant)
                evidence += _log_prior(length, LENGTH_PRIOR) + _log_prior(amplitude, prior.amplitude_prior)
                self._fits.append(_Fit(index, amplitude, (inverse + inverse.T) / 2, solved, evidence))

    def at_vertices(self) -> tuple[Array, Array]:
        """Return posterior mean (n, c) and variance (n, c) at the vertices."""
        mean, square = self._moments(self._field.modes, self._trend)
        return mean, np.maximum(square - mean**2, 0.0)

    def mean_at(self, rows: csr_array) -> Array:
        """Return the posterior mean (m, c) where ``rows`` (m, n) interpolate the vertices."""
        return self._moments(rows @ self._field.modes, rows @ self._trend, variance=False)[0]

    def leave_one_out(self) -> tuple[Array, Array]:
        """Predict each value from all others: mean (k, c) and variance (k, c), the measurement's error included.

        The weights of length and amplitude are also computed without that value. Closed form: Rasmussen & Williams,
        Gaussian Processes for Machine Learning, equations (5.10) to (5.12).
        """
        variance = np.array([1 / np.diag(fit.inverse) for fit in self._fits])[..., None]
        offset = np.array([fit.solved for fit in self._fits]) * variance
        own = -0.5 * (np.log(variance) + offset**2 / variance).sum(axis=2)
        evidence = np.array([fit.evidence for fit in self._fits])[:, None] - own
        weights = np.exp(evidence - logsumexp(evidence, axis=0))[..., None]
        mean = (weights * offset).sum(axis=0)
        spread = (weights * (variance + offset**2)).sum(axis=0) - mean**2
        return self._values - mean, spread

    def _moments(self, modes: Array, trend: Array, *, variance: bool = True) -> tuple[Array, Array]:
        """Return the posterior's mean (n, c), and the mean of its square.

        Without the variance, the second is that of the uncertain lengths and amplitudes alone.
        """
        evidence = np.array([fit.evidence for fit in self._fits])
        weights = np.exp(evidence - logsumexp(evidence))
        weights[weights < _LEAST_WEIGHT] = 0.0
        weights /= weights.sum()
        mean = np.zeros((len(modes), self._values.shape[1]))
        square = np.zeros_like(mean)
        trend_variance = (trend**2).sum(axis=1)
        for index, spectrum in enumerate(self._field.spectra):
            chosen = [(w, fit) for w, fit in zip(weights, self._fits, strict=True) if w and fit.length_index == index]
            if not chosen:
                continue
            # The covariance with the sites is ``both @ known`` for every amplitude. So the variances of all amplitudes need one
            # product of the size of the surface.
            covariance = (modes * spectrum) @ self._at_sites.T
            both = np.concatenate([covariance, trend], axis=1)
            k = len(self._values)
            explained = np.zeros((both.shape[1],) * 2)
            shares, powers = np.array([w for w, _ in chosen]), np.array([fit.amplitude**2 for _, fit in chosen])
            for weight, power, (_, fit) in zip(shares, powers, chosen, strict=True):
                known = np.concatenate([power * np.eye(k), self._trend_at_sites.T])
                here = both @ (known @ fit.solved)
                mean += weight * here
                square += weight * here**2
                if variance:
                    explained += weight * (known @ fit.inverse @ known.T)
            if variance:
                left = (shares @ powers) * (modes**2 @ spectrum) + shares.sum() * trend_variance
                left -= np.einsum("nk,nk->n", both @ explained, both)
                square += np.maximum(left, 0.0)[:, None]
        return mean, square


@dataclass(frozen=True, eq=False, slots=True)
class _Fit:
    length_index: int
    amplitude: float
    inverse: Array
    solved: Array
    evidence: float


def _log_prior(value: float, prior: tuple[float, float]) -> float:
    centre, spread = prior
    return -0.5 * float(np.log(value / centre) / spread) ** 2
