"""Activation times over the wall from the times at the sites, with or without a cycle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array

from fluoromap.contracts import Array
from fluoromap.fuser.reentry_cycle import Cycle
from fluoromap.fuser.surface import SurfacePoints
from fluoromap.fuser.surface_field import FieldPrior, Regression, SurfaceField

LEAST_SD_MS = 0.41
"""Smallest error of an activation time, ms: a difference of two times read at 1000 samples/s has sqrt(2/12) ms."""

TIME_PRIOR = FieldPrior((1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0), (12.0, 1.2), level_sd=200.0, slope_sd_per_mm=1.0)
# Cosine and sine of a phase with all values have a standard deviation of 0.7; with fewer values it is smaller.
PHASE_PRIOR = FieldPrior((0.1, 0.2, 0.4, 0.7, 1.0), (0.5, 0.7), level_sd=1.0, slope_sd_per_mm=0.02)


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Prediction of each site's time from the other sites: predicted_ms (k,), sd_ms (k,) with the measurement's error."""

    predicted_ms: Array
    sd_ms: Array


class ActivationTimes:
    """The times of k sites, interpolated over the surface.

    With a cycle the field is that of the phase's cosine and sine, so that early meets late without a jump. Its times lie in
    the window of interest.

    Parameters
    ----------
    field : SurfaceField
    vertices_mm : (n, 3)
        The surface's vertices.
    points : SurfacePoints
        The sites' points on the surface.
    lat_ms, lat_sd_ms : (k,)
        Times and their standard deviations; times within the window where there is a cycle.
    covariance_mm2 : (k, 3, 3)
        Covariances of the sites' positions. The slope of the times along the surface turns them into errors of time:
        McHutchon & Rasmussen, Gaussian Process Training with Input Noise, NIPS 24 (2011), equation (4).
    cycle : Cycle or None
        The cycle of a re-entry.
    """

    def __init__(
        self,
        field: SurfaceField,
        vertices_mm: Array,
        points: SurfacePoints,
        lat_ms: Array,
        lat_sd_ms: Array,
        covariance_mm2: Array,
        cycle: Cycle | None,
    ) -> None:
        self._field, self._cycle, self._points = field, cycle, points
        self._level = 0.0 if cycle else float(np.median(lat_ms))
        self._lat = lat_ms
        variance = np.maximum(lat_sd_ms, LEAST_SD_MS) ** 2
        slope = self._slopes(self._regress(variance), vertices_mm)
        self._variance = variance + np.einsum("ki,kij,kj->k", slope, covariance_mm2, slope)
        self._regression = self._regress(self._variance)

    @property
    def sd_ms(self) -> Array:
        """Standard deviation (k,) of each site's time at its point on the surface, ms."""
        sd: Array = np.sqrt(self._variance)
        return sd

    def at_vertices(self) -> tuple[Array, Array]:
        """Return mean and standard deviation at the vertices, (n,), (n,) in ms."""
        return self._in_ms(*self._regression.at_vertices())

    def at(self, points: SurfacePoints) -> Array:
        """Return the mean (m,) in ms at other points."""
        mean = self._regression.mean_at(self._field.rows(points))
        return self._in_ms(mean, np.zeros_like(mean))[0]

    def leave_one_out(self) -> LeaveOneOut:
        """Predict each site's time from the other sites."""
        return LeaveOneOut(*self._in_ms(*self._regression.leave_one_out()))

    def _regress(self, variance_ms2: Array) -> Regression:
        if self._cycle is None:
            return self._field.regress(self._points, (self._lat - self._level)[:, None], variance_ms2, TIME_PRIOR)
        phase = self._cycle.phase(self._lat)
        values = np.column_stack([np.cos(phase), np.sin(phase)])
        return self._field.regress(self._points, values, variance_ms2 * self._cycle.per_ms**2, PHASE_PRIOR)

    def _in_ms(self, mean: Array, variance: Array) -> tuple[Array, Array]:
        if self._cycle is None:
            return mean[:, 0] + self._level, np.sqrt(variance[:, 0])
        return self._cycle.times(mean, variance)

    def _slopes(self, regression: Regression, vertices_mm: Array) -> Array:
        """Return the gradient (k, 3) of the mean time in the face of each site, ms/mm."""
        corners = self._field.faces[self._points.faces]
        k = len(corners)
        where = (np.arange(3 * k), corners.ravel())
        rows = coo_array((np.ones(3 * k), where), shape=(3 * k, len(vertices_mm))).tocsr()
        mean = regression.mean_at(rows)
        times = self._in_ms(mean, np.zeros_like(mean))[0].reshape(k, 3)
        rise = times[:, 1:] - times[:, :1]
        if self._cycle is not None:
            rise = self._cycle.difference(times[:, 1:], times[:, :1])
        places = vertices_mm[corners]
        sides = places[:, 1:] - places[:, :1]
        # The least-norm solution of the two differences lies in the face's plane, also for needle-shaped faces.
        slope: Array = np.einsum("kij,kj->ki", np.linalg.pinv(sides, rcond=1e-3), rise)
        return slope
