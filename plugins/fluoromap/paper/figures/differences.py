"""Differences between two maps of the same sites, in mm and in ms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, ChamberMap
from fluoromap.fuser.surface import nearest_on_surface
from fluoromap.paper.figures.moment import MomentInView, SiteAtMoment

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SiteDifference:
    """One site in both maps.

    frame : of the run, from 1. exact_mm, single_view_mm : the tip minus the reference catheter's mean, LPS axes.
    other_cycles_mm : from the single view with only the cycles of other sites. ray : unit vector from the source to the
    true tip. distance_mm : between single view and exact. along_ray_mm : the part of that difference along the ray,
    positive away from the source. lateral_mm : its length across the ray.
    """

    site: str
    lat_ms: float
    frame: int
    exact_mm: Vector
    single_view_mm: Vector
    other_cycles_mm: Vector
    ray: Vector
    distance_mm: float
    along_ray_mm: float
    lateral_mm: float


@dataclass(frozen=True, slots=True)
class MapDifference:
    """Two maps of the same sites.

    rms_mm, rms_along_ray_mm, rms_lateral_mm : over the sites. farthest_site : the site with the largest distance.
    median_ms, largest_ms : of the absolute differences of time, see :func:`time_differences_ms`. covered_points : vertices
    of the exact map's covered wall. compared_points : those of them that the other map covers too. other_cycles_rms_mm,
    other_cycles_largest_mm : distances from exact with only the cycles of other sites.
    """

    rms_mm: float
    rms_along_ray_mm: float
    rms_lateral_mm: float
    largest_mm: float
    farthest_site: str
    median_ms: float
    largest_ms: float
    covered_points: int
    compared_points: int
    other_cycles_rms_mm: float
    other_cycles_largest_mm: float


def site_differences(sites: Sequence[SiteAtMoment]) -> tuple[SiteDifference, ...]:
    """Return each site's two positions and their difference along and across the ray."""
    differences = []
    for site in sites:
        apart = site.single_view.tip_mm - site.exact.tip_mm
        along = float(apart @ site.ray)
        differences.append(
            SiteDifference(
                site.exact.site,
                site.exact.lat_ms,
                site.frame + 1,
                _vector(site.exact.tip_mm),
                _vector(site.single_view.tip_mm),
                _vector(site.other_cycles_mm),
                _vector(site.ray),
                float(np.linalg.norm(apart)),
                along,
                float(np.linalg.norm(apart - along * site.ray)),
            )
        )
    return tuple(differences)


def map_difference(moment: MomentInView, sites: Sequence[SiteDifference]) -> MapDifference:
    """Return the difference of a moment's two maps over the sites and the covered wall."""
    farthest = max(sites, key=lambda site: site.distance_mm)
    times = time_differences_ms(moment.exact, moment.single_view)
    other_cycles = [float(np.linalg.norm(np.subtract(site.other_cycles_mm, site.exact_mm))) for site in sites]
    return MapDifference(
        rms_mm=_root_mean_square([site.distance_mm for site in sites]),
        rms_along_ray_mm=_root_mean_square([site.along_ray_mm for site in sites]),
        rms_lateral_mm=_root_mean_square([site.lateral_mm for site in sites]),
        largest_mm=farthest.distance_mm,
        farthest_site=farthest.site,
        median_ms=float(np.median(times)),
        largest_ms=float(times.max()),
        covered_points=int(moment.exact.covered.sum()),
        compared_points=len(times),
        other_cycles_rms_mm=_root_mean_square(other_cycles),
        other_cycles_largest_mm=max(other_cycles),
    )


def time_differences_ms(first: ChamberMap, second: ChamberMap) -> Array:
    """Return the absolute differences of time (k,) between two maps.

    Covered vertices of the first map are compared with the nearest points of the second map's wall, where it is covered
    too.
    """
    near = nearest_on_surface(second.vertices_mm, second.faces, first.vertices_mm[first.covered])
    interpolated = near.rows(second.faces, len(second.vertices_mm))
    both = interpolated @ (~second.covered).astype(np.float64) < 1e-9
    differences: Array = np.abs(interpolated @ second.lat_ms - first.lat_ms[first.covered])[both]
    return differences


def _root_mean_square(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _vector(values: Array) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)
