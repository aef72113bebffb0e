"""Chambers of known truth: sites on an ellipsoid with a plane or a spherical wave over it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import ChamberMap, MappedSite, Silent
from fluoromap.fuser.convex_hull import ConvexHull, ConvexHullParams
from fluoromap.fuser.smooth_surface import SmoothSurface, SmoothSurfaceParams

Array = NDArray[np.float64]


def directions(count: int) -> Array:
    """Return evenly spread unit vectors (count, 3): Fibonacci's sphere."""
    index = np.arange(count) + 0.5
    z, angle = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    around = np.sqrt(1 - z**2)
    return np.column_stack([around * np.cos(angle), around * np.sin(angle), z])


def sites_at(tips_mm: Array, lat_ms: Array, lat_sd_ms: float = 1.0) -> tuple[MappedSite, ...]:
    centre = tips_mm.mean(axis=0)
    sites = []
    for index, (tip, lat) in enumerate(zip(tips_mm, lat_ms, strict=True)):
        axis = (tip - centre) / np.linalg.norm(tip - centre)
        sites.append(MappedSite(f"S{index + 1:02d}", tip, 0.3 * np.eye(3), axis, 4.0, float(lat), lat_sd_ms))
    return tuple(sites)


def sphere(count: int, radius_mm: float = 25.0, slope_ms_per_mm: float = 1.0) -> tuple[MappedSite, ...]:
    """Return a plane wave along X over a sphere.

    The centre is (10, -20, 5). Times go from negative to positive.
    """
    tips = radius_mm * directions(count) + [10.0, -20.0, 5.0]
    return sites_at(tips, slope_ms_per_mm * (tips[:, 0] - 10.0))


def wave(count: int, seed: int, lat_sd_ms: float = 1.5) -> tuple[tuple[MappedSite, ...], Array]:
    """Return a wave from one focus over an ellipsoid.

    Sites are irregular and times have noise; the times without noise are returned too.
    """
    rng = np.random.default_rng(seed)
    spread = directions(count) + 0.2 * rng.normal(size=(count, 3))
    spread /= np.linalg.norm(spread, axis=1, keepdims=True)
    focus = rng.normal(size=3)
    focus /= np.linalg.norm(focus)
    truth = -15 + np.arccos(np.clip(spread @ focus, -1, 1)) * 28 / rng.uniform(0.6, 1.2)
    tips = spread * [24.0, 22.0, 40.0] + 0.8 * rng.normal(size=(count, 3))
    return sites_at(tips, truth + lat_sd_ms * rng.normal(size=count), lat_sd_ms), truth


def fused(sites: tuple[MappedSite, ...], **params: object) -> ChamberMap:
    return ConvexHull(ConvexHullParams.model_validate(params)).fuse(sites, Silent())


def smooth(sites: tuple[MappedSite, ...], **params: object) -> ChamberMap:
    return SmoothSurface(SmoothSurfaceParams.model_validate(params)).fuse(sites, Silent())
