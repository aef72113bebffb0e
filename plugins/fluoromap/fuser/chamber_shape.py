"""Shape of a chamber's wall from few places on it: an ellipsoid and departures from it.

Both come from Bayesian regression. The ellipsoid is the most probable one under a prior for the size and roundness of heart
chambers. The departures along its normals are a Gaussian process over the ellipsoid (Rasmussen & Williams, Gaussian
Processes for Machine Learning, 2006, chapter 2), averaged over its length and amplitude by evidence. Between two sites the
wall therefore bulges beyond the chord as a chamber does; it is concave where the sites show that. Implicit surfaces by
Gaussian processes: Williams & Fitzgibbon, Gaussian Process Implicit Surfaces, 2007.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import least_squares
from scipy.spatial.distance import cdist
from scipy.special import logsumexp

from fluoromap.contracts import Array, IntArray
from fluoromap.fuser.surface import hull_surface, refine

# A ventricle or atrium has 15 to 45 mm mean radius and is up to about twice as long as wide. The priors are wide, so that
# 20 sites outweigh them.
LOG_RADIUS_PRIOR = (np.log(26.0), 0.35)
ELONGATION_SD = 0.35
CENTRE_SD_MM = 15.0
DEPARTURE_SD_MM = 2.5
ROUGHNESS_MM = 0.5
LENGTHS_MM = (15.0, 25.0, 40.0)
AMPLITUDES_MM = (0.5, 1.0, 2.0, 4.0, 8.0)
AMPLITUDE_PRIOR = (DEPARTURE_SD_MM, 0.7)
LEAST_RADIUS = 0.2
"""Smallest radius as a share of the ellipsoid's, so that departures never turn the surface inside out."""

_DIRECTIONS = 600
_SQRT_HALF = float(np.sqrt(0.5))


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An ellipsoid: centre_mm (3,); shape_mm (3, 3), symmetric, maps the unit sphere onto it about the centre."""

    centre_mm: Array
    shape_mm: Array

    def to_sphere(self, points_mm: Array) -> Array:
        """Return points (k, 3) in the axes where the ellipsoid is the unit sphere."""
        return np.linalg.solve(self.shape_mm, (points_mm - self.centre_mm).T).T.astype(np.float64)

    def normals(self, directions: Array) -> tuple[Array, Array]:
        """Return the ellipsoid's unit normals in unit directions (k, 3) of the sphere.

        Returns
        -------
        ndarray (k, 3), ndarray (k,)
            The normals, and the length of one millimetre along each in radii of the sphere.
        """
        gradient = np.linalg.solve(self.shape_mm, directions.T).T
        per_mm: Array = np.linalg.norm(gradient, axis=1).astype(np.float64)
        return gradient / per_mm[:, None], per_mm


def wall_surface(points_mm: Array, covariance_mm2: Array, edge_mm: float) -> tuple[Array, IntArray]:
    """Make a closed outward surface through or near points (k, 3) with covariances (k, 3, 3).

    There are at least four points, not all in one plane. The surface is star-shaped about the ellipsoid's centre, so that
    it never cuts itself. Its edges are about ``edge_mm`` at most.
    """
    shape = _ChamberShape(points_mm, covariance_mm2)
    directions, faces = _even_sphere()
    vertices, faces = refine(shape.at(directions), faces, edge_mm)
    scaled = shape.ellipsoid.to_sphere(vertices)
    return shape.at(scaled / np.linalg.norm(scaled, axis=1, keepdims=True)), faces


class _ChamberShape:
    """The wall as a distance from the ellipsoid's centre in every direction."""

    def __init__(self, points_mm: Array, covariance_mm2: Array) -> None:
        self.ellipsoid = fit_ellipsoid(points_mm, covariance_mm2)
        scaled = self.ellipsoid.to_sphere(points_mm)
        radius = np.maximum(np.linalg.norm(scaled, axis=1), 1e-9)
        directions = scaled / radius[:, None]
        normals, per_mm = self.ellipsoid.normals(directions)
        self._departures = _Departures(
            directions @ self.ellipsoid.shape_mm,
            (radius - 1) / per_mm,
            np.einsum("ki,kij,kj->k", normals, covariance_mm2, normals) + ROUGHNESS_MM**2,
        )

    def at(self, directions: Array) -> Array:
        """Return wall points (n, 3), mm, in unit directions (n, 3) of the ellipsoid's sphere."""
        _, per_mm = self.ellipsoid.normals(directions)
        departure = self._departures.mean(directions @ self.ellipsoid.shape_mm)
        radius = np.maximum(1 + departure * per_mm, LEAST_RADIUS)
        wall: Array = self.ellipsoid.centre_mm + (radius[:, None] * directions) @ self.ellipsoid.shape_mm
        return wall


def fit_ellipsoid(points_mm: Array, covariance_mm2: Array) -> Ellipsoid:
    """Fit the most probable ellipsoid of a chamber to points (k, 3) with covariances (k, 3, 3).

    Distances are to first order: the implicit function over its gradient (Taubin, IEEE PAMI 13 (1991) 1115). The shape is
    the exponential of a symmetric matrix, so that all parameters are unbounded and all axes are equivalent.
    """
    start = points_mm.mean(axis=0)
    log_radius, log_radius_sd = LOG_RADIUS_PRIOR

    def residuals(parameters: Array) -> Array:
        ellipsoid = _ellipsoid(parameters, start)
        scaled = ellipsoid.to_sphere(points_mm)
        radius = np.maximum(np.linalg.norm(scaled, axis=1), 1e-9)
        normals, per_mm = ellipsoid.normals(scaled / radius[:, None])
        variance = np.einsum("ki,kij,kj->k", normals, covariance_mm2, normals) + DEPARTURE_SD_MM**2
        misfit = (radius - 1) / per_mm / np.sqrt(variance)
        size = (parameters[3:6].mean() - log_radius) / log_radius_sd
        elongation = np.concatenate([parameters[3:6] - parameters[3:6].mean(), parameters[6:]]) / ELONGATION_SD
        return np.concatenate([misfit, [size], elongation, parameters[:3] / CENTRE_SD_MM])

    first = np.zeros(9)
    first[3:6] = np.log(np.clip(np.linalg.norm(points_mm - start, axis=1).mean(), 5.0, 100.0))
    found = least_squares(residuals, first, method="lm", x_scale=[10.0] * 3 + [0.3] * 6, xtol=1e-7, ftol=1e-7)
    return _ellipsoid(found.x, start)


def _ellipsoid(parameters: Array, start: Array) -> Ellipsoid:
    xx, yy, zz, yz, xz, xy = parameters[3:]
    # Off-diagonals are scaled so that a rotation of the axes changes neither the sum of squares nor the prior.
    yz, xz, xy = _SQRT_HALF * yz, _SQRT_HALF * xz, _SQRT_HALF * xy
    values, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    return Ellipsoid(start + parameters[:3], (axes * np.exp(np.clip(values, 0.0, 6.0))) @ axes.T)


class _Departures:
    """Gaussian process of the wall's distance from the ellipsoid along its normals, mm, from values at k places.

    Parameters
    ----------
    places_mm : (k, 3)
        Places on the ellipsoid, from its centre.
    values_mm, variances_mm2 : (k,)
        Departures and their variances.
    """

    def __init__(self, places_mm: Array, values_mm: Array, variances_mm2: Array) -> None:
        self._places = places_mm
        evidence, solved = [], []
        centre, spread = AMPLITUDE_PRIOR
        apart_mm = cdist(places_mm, places_mm)
        for length in LENGTHS_MM:
            shape = _matern(apart_mm, length)
            for amplitude in AMPLITUDES_MM:
                factor = cho_factor(amplitude**2 * shape + np.diag(variances_mm2), lower=True)
                weights = cho_solve(factor, values_mm)
                log_determinant = 2 * np.log(np.diag(factor[0])).sum()
                evidence.append(
                    -0.5 * (values_mm @ weights + log_determinant + (np.log(amplitude / centre) / spread) ** 2)
                )
                solved.append(amplitude**2 * weights)
        share = np.exp(np.array(evidence) - logsumexp(evidence))
        # The mean is linear in the weights, so that the weights of one length add up over its amplitudes.
        self._weights = np.einsum("la,lak->lk", share.reshape(len(LENGTHS_MM), -1),
                                  np.array(solved).reshape(len(LENGTHS_MM), -1, len(values_mm)))  # fmt: skip

    def mean(self, places_mm: Array) -> Array:
        """Return the expected departure (n,), mm, at places (n, 3) on the ellipsoid, from its centre."""
        total, apart_mm = np.zeros(len(places_mm)), cdist(places_mm, self._places)
        for length, weights in zip(LENGTHS_MM, self._weights, strict=True):
            total += _matern(apart_mm, length) @ weights
        return total


def _matern(apart_mm: Array, length_mm: float) -> Array:
    """Return the Matern 5/2 correlation at distances (n, k), Rasmussen & Williams equation (4.17)."""
    distance = np.sqrt(5.0) / length_mm * apart_mm
    correlation: Array = (1 + distance * (1 + distance / 3)) * np.exp(-distance)
    return correlation


@functools.cache
def _even_sphere() -> tuple[Array, IntArray]:
    """Return the unit sphere as a surface of evenly spread vertices."""
    return hull_surface(_even_directions(_DIRECTIONS))


def _even_directions(count: int) -> Array:
    """Return evenly spread unit vectors (count, 3) on Fibonacci's spiral."""
    index = np.arange(count) + 0.5
    height, angle = 1 - 2 * index / count, np.pi * (1 + np.sqrt(5.0)) * index
    around = np.sqrt(1 - height**2)
    return np.column_stack([around * np.cos(angle), around * np.sin(angle), height])
