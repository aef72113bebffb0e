"""Conduction velocity along the wall where enough sites lie close together."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from fluoromap.contracts import Array, ConductionVelocity, IntArray

NEAR_MM = 15.0
LEAST_SITES = 4
LARGEST_RELATIVE_SD = 0.3
"""Largest relative standard deviation of a local slowness that still determines a speed."""

MISFIT_LEVEL = 0.99
_DRAWS = 1000


@dataclass(frozen=True, eq=False, slots=True)
class _PlaneWave:
    """Slowness (2,) in ms/mm along two tangents, and the matrix (2, m) that computes it from the times of ``sites`` (m,)."""

    sites: IntArray
    slowness: Array
    of_times: Array


def conduction_velocity(
    places_mm: Array,
    normals: Array,
    lat_ms: Array,
    sd_ms: Array,
    difference: Callable[[Array, Array], Array],
) -> ConductionVelocity | None:
    """Return the median speed of local plane waves and its 95 % interval.

    A plane wave is fitted wherever at least four sites lie within 15 mm of a site. The times around that site are fitted by
    least squares as a plane over the wall (Bayly et al., IEEE Trans. Biomed. Eng. 45 (1998) 563), unfolded into the tangent
    plane. A fit is left out where a plane wave does not explain the times (a focus, a collision) or where the slowness is
    too uncertain. Noise lengthens a fitted slowness vector; its expected square is subtracted. The interval comes from
    redrawing the times' errors, the same for all fits that share a site, and from resampling the fits.

    Parameters
    ----------
    places_mm, normals : (k, 3)
        Sites on the surface and the wall's unit normals there.
    lat_ms, sd_ms : (k,)
        Times and their standard deviations, the positions' errors included.
    difference : callable
        Difference of two arrays of times; around the cycle where there is one.

    Returns
    -------
    ConductionVelocity or None
        In m/s; None where no sites lie close enough or all fits are left out.
    """
    waves = _plane_waves(places_mm, normals, lat_ms, sd_ms, difference)
    if not waves:
        return None
    # The seed is fixed, so that the same sites always give the same interval.
    rng = np.random.default_rng(0)
    errors = sd_ms * rng.normal(size=(_DRAWS, len(sd_ms)))
    samples = np.empty((_DRAWS, len(waves)))
    local = np.empty(len(waves))
    for column, wave in enumerate(waves):
        excess = float(((wave.of_times * sd_ms[wave.sites]) ** 2).sum())
        square = float(wave.slowness @ wave.slowness)
        moved = wave.slowness + errors[:, wave.sites] @ wave.of_times.T
        local[column] = _speed(np.array(square - excess), square)
        samples[:, column] = _speed((moved**2).sum(axis=1) - 2 * excess, square)
    resampled = rng.integers(len(waves), size=(_DRAWS, len(waves)))
    medians = np.median(np.take_along_axis(samples, resampled, axis=1), axis=1)
    low, high = np.percentile(medians, [2.5, 97.5])
    median = float(np.median(local))
    return ConductionVelocity(median, min(float(low), median), max(float(high), median))


def _plane_waves(
    places_mm: Array, normals: Array, lat_ms: Array, sd_ms: Array, difference: Callable[[Array, Array], Array]
) -> list[_PlaneWave]:
    waves, neighbourhoods = [], set()
    for centre, normal, own_lat in zip(places_mm, normals, lat_ms, strict=True):
        offset = places_mm - centre
        distance = np.linalg.norm(offset, axis=1)
        # A site on the opposite wall of a thin chamber is near in space only.
        sites = np.flatnonzero((distance <= NEAR_MM) & (normals @ normal > 0))
        if len(sites) < LEAST_SITES or sites.tobytes() in neighbourhoods:
            continue
        neighbourhoods.add(sites.tobytes())
        wave = _plane_wave(
            _unfold(offset[sites], distance[sites], normal),
            difference(lat_ms[sites], np.full(len(sites), own_lat)),
            sd_ms[sites],
            sites,
        )
        if wave is not None:
            waves.append(wave)
    return waves


def _unfold(offset_mm: Array, distance_mm: Array, normal: Array) -> Array:
    """Unfold offsets (m, 3) into the tangent plane (m, 2).

    The direction comes from projection, the length is the straight distance. On a wall of 25 mm radius that is 1.5 % too
    short at 15 mm.
    """
    _, _, axes = np.linalg.svd(normal[None])
    flat = offset_mm @ axes[1:].T
    stretch = distance_mm / np.maximum(np.linalg.norm(flat, axis=1), 1e-9)
    unfolded: Array = flat * np.where(distance_mm > 0, stretch, 1.0)[:, None]
    return unfolded


def _plane_wave(flat_mm: Array, times_ms: Array, sd_ms: Array, sites: IntArray) -> _PlaneWave | None:
    design = np.column_stack([flat_mm, np.ones(len(flat_mm))]) / sd_ms[:, None]
    if np.linalg.matrix_rank(design, tol=1e-6 * np.linalg.norm(design)) < 3:
        return None
    inverse = np.linalg.pinv(design)
    fitted = inverse @ (times_ms / sd_ms)
    misfit = float(((design @ fitted - times_ms / sd_ms) ** 2).sum())
    slowness, covariance = fitted[:2], (inverse @ inverse.T)[:2, :2]
    square = float(slowness @ slowness)
    # The slowness must exceed its error in every direction, not only along itself; else its length is mostly noise.
    if misfit > _largest_misfit(len(sites) - 3) or not np.linalg.eigvalsh(covariance)[-1] < (
        LARGEST_RELATIVE_SD**2 * square
    ):
        return None
    return _PlaneWave(sites, slowness, inverse[:2] / sd_ms)


@functools.cache
def _largest_misfit(degrees_of_freedom: int) -> float:
    return float(chi2.ppf(MISFIT_LEVEL, degrees_of_freedom))


def _speed(square: Array, fitted_square: float) -> Array:
    """Return the speed in mm/ms, that is m/s, of a squared slowness.

    The square is at least a tenth of the fitted one; below that it is noise.
    """
    speed: Array = 1 / np.sqrt(np.maximum(square, 0.1 * fitted_square))
    return speed
