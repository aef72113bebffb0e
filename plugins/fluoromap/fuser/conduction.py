"""Conduction velocity along the wall where enough sites lie close together."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

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
    # Neighbourhoods of the same size are fitted together.
    of_size: dict[int, list[tuple[int, IntArray]]] = {}
    neighbourhoods = set()
    offsets = places_mm - places_mm[:, None]
    distances = np.linalg.norm(offsets, axis=2)
    for site, normal in enumerate(normals):
        # A site on the opposite wall of a thin chamber is near in space only.
        sites = np.flatnonzero((distances[site] <= NEAR_MM) & (normals @ normal > 0))
        if len(sites) >= LEAST_SITES and sites.tobytes() not in neighbourhoods:
            neighbourhoods.add(sites.tobytes())
            of_size.setdefault(len(sites), []).append((site, sites))
    waves: dict[int, _PlaneWave] = {}
    for alike in of_size.values():
        centres, sites = np.array([centre for centre, _ in alike]), np.array([sites for _, sites in alike])
        at = centres[:, None], sites
        flat = _unfold(offsets[at], distances[at], normals[centres])
        times = difference(lat_ms[sites], np.broadcast_to(lat_ms[centres, None], sites.shape))
        for centre, wave in zip(centres.tolist(), _fitted(flat, times, sd_ms[sites], sites), strict=True):
            if wave is not None:
                waves[centre] = wave
    return [waves[site] for site in sorted(waves)]


def _unfold(offset_mm: Array, distance_mm: Array, normals: Array) -> Array:
    """Unfold offsets (g, m, 3) of g neighbourhoods into the tangent planes (g, m, 2).

    The direction comes from projection, the length is the straight distance. On a wall of 25 mm radius that is 1.5 % too
    short at 15 mm.
    """
    _, _, axes = np.linalg.svd(normals[:, None])
    flat = offset_mm @ np.swapaxes(axes[:, 1:], -1, -2)
    stretch = distance_mm / np.maximum(np.linalg.norm(flat, axis=2), 1e-9)
    unfolded: Array = flat * np.where(distance_mm > 0, stretch, 1.0)[..., None]
    return unfolded


def _fitted(flat_mm: Array, times_ms: Array, sd_ms: Array, sites: IntArray) -> list[_PlaneWave | None]:
    """Fit a plane wave to each of g neighbourhoods of m sites.

    Places are (g, m, 2); times, their standard deviations and the indices of the sites are (g, m). A wave is None where the fit is
    left out.
    """
    design = np.concatenate([flat_mm, np.ones((*flat_mm.shape[:2], 1))], axis=2) / sd_ms[..., None]
    size = np.linalg.norm(design, axis=(1, 2))
    is_plane = np.linalg.matrix_rank(design, tol=1e-6 * size) == 3
    inverse = np.linalg.pinv(design)
    weighted = (times_ms / sd_ms)[..., None]
    fitted = inverse @ weighted
    misfits = ((design @ fitted - weighted)[..., 0] ** 2).sum(axis=1)
    covariance = (inverse @ np.swapaxes(inverse, -1, -2))[:, :2, :2]
    slowness = fitted[:, :2, 0]
    # The slowness must exceed its error in every direction, not only along itself; else its length is mostly noise.
    is_known = np.linalg.eigvalsh(covariance)[:, -1] < LARGEST_RELATIVE_SD**2 * (slowness**2).sum(axis=1)
    is_wave = is_plane & ~(misfits > _largest_misfit(sites.shape[1] - 3)) & is_known
    of_times = inverse[:, :2] / sd_ms[:, None]
    return [
        _PlaneWave(own, its_slowness, of) if holds else None
        for own, its_slowness, of, holds in zip(sites, slowness, of_times, is_wave, strict=True)
    ]


@functools.cache
def _largest_misfit(degrees_of_freedom: int) -> float:
    # The quantile of chi squared; scipy.stats would delay the start of every process by half a second.
    return float(2.0 * gammaincinv(0.5 * degrees_of_freedom, MISFIT_LEVEL))


def _speed(square: Array, fitted_square: float) -> Array:
    """Return the speed in mm/ms, that is m/s, of a squared slowness.

    The square is at least a tenth of the fitted one; below that it is noise.
    """
    speed: Array = 1 / np.sqrt(np.maximum(square, 0.1 * fitted_square))
    return speed
