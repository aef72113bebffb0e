"""Accuracy of the map: ``python benchmarks/map.py [first seed] [chambers]``; defaults 9000 and 100.

Each seed draws a chamber that is not an ellipsoid (semi-axes 18-28, 18-28, 30-48 mm, bumps and hollows of 8 %, bent), a focus
on its wall, a velocity of 0.6 to 1 m/s, and 20 sites outside the basal quarter with the valves. True times come from the way
along the wall over 5000 points. Both fusers get the same sites. Times at the covered vertices, weighted by area, are compared
with the true time of the nearest wall. SciPy's thin-plate RBFInterpolator through space gets the same sites and vertices.

The next tables give the velocity with dense sites, seconds and memory, and milliseconds of an overlay on a rendered frame
(both in processor time of one thread). All figures are means over chambers with 95 % bootstrap intervals.
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import ConvexHull as Hull
from scipy.spatial import cKDTree

from fluoromap.contracts import ChamberMap, Fuser, MappedSite, Silent
from fluoromap.drawing.overlay import Look, draw_overlay
from fluoromap.drawing.png import encode_png
from fluoromap.fuser.surface import face_areas_mm2, hull_surface, volume_mm3
from fluoromap.geometry import camera_from_gantry
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.registry import build_fuser

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

FUSERS = ("convex-hull", "smooth-surface")
TIME_SD_MS = 1.5
WALL_POINTS = 5000
STEP_MM = 6.0


@dataclass(frozen=True, eq=False)
class Truth:
    """Truth of a chamber: points_mm (n, 3) on the wall, lat_ms (n,), and ``wall``, indices of points for sites."""

    points_mm: Array
    lat_ms: Array
    wall: IntArray
    volume_ml: float
    velocity_m_per_s: float

    def times_at(self, places_mm: Array) -> Array:
        """Return the true time (m,) at the nearest wall, interpolated between its three nearest points."""
        distance, nearest = cKDTree(self.points_mm).query(places_mm, k=3)
        weight: Array = 1 / (np.asarray(distance) + 1e-3)
        times: Array = (weight * self.lat_ms[nearest]).sum(axis=1) / weight.sum(axis=1)
        return times


def draw_chamber(rng: np.random.Generator) -> Truth:
    index = np.arange(WALL_POINTS) + 0.5
    height, angle = 1 - 2 * index / WALL_POINTS, np.pi * (1 + 5**0.5) * index
    around = np.sqrt(1 - height**2)
    unit, faces = hull_surface(np.column_stack([around * np.cos(angle), around * np.sin(angle), height]))
    semi_axes = np.array([rng.uniform(18, 28), rng.uniform(18, 28), rng.uniform(30, 48)])
    centres = _unit(rng.normal(size=(8, 3)))
    bumps = np.exp((unit @ centres.T - 1) / 0.25) @ rng.normal(0, 0.08, 8)
    points = unit * semi_axes * (1 + bumps)[:, None]
    points[:, :2] += rng.normal(0, 4, 2) * (unit[:, 2:] ** 2 - 1 / 3)
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    points = points @ (axes * np.sign(np.linalg.det(axes))) + rng.normal(0, 10, 3)
    wall = np.flatnonzero(unit[:, 2] > -0.5)
    tree = cKDTree(points)
    # Straight steps of up to 6 mm between wall points are within 0.5 % of the way along the wall.
    steps = tree.sparse_distance_matrix(tree, STEP_MM, output_type="coo_matrix").tocsr()
    velocity = float(rng.uniform(0.6, 1.0))
    lat = dijkstra(steps, indices=[int(rng.choice(wall))], min_only=True) / velocity - rng.uniform(0, 60)
    return Truth(points, lat, wall, abs(volume_mm3(points, faces)) / 1e3, velocity)


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


def spread(truth: Truth, count: int, rng: np.random.Generator) -> IntArray:
    """Choose wall points far from each other.

    An operator who maps the whole chamber does so.
    """
    candidates = rng.permutation(truth.wall)
    chosen = [int(candidates[0])]
    nearest = np.full(len(candidates), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(truth.points_mm[candidates] - truth.points_mm[chosen[-1]], axis=1))
        chosen.append(int(candidates[int(np.argmax(nearest))]))
    return np.array(chosen)


def scattered(truth: Truth, count: int, rng: np.random.Generator) -> IntArray:
    """Choose wall points at random: some walls are crowded, some empty."""
    return rng.choice(truth.wall, count, replace=False)


def sites_at(truth: Truth, places: IntArray, noise_mm: float, rng: np.random.Generator) -> tuple[MappedSite, ...]:
    tips = truth.points_mm[places] + noise_mm * rng.normal(size=(len(places), 3))
    times = truth.lat_ms[places] + TIME_SD_MS * rng.normal(size=len(places))
    covariance = noise_mm**2 * np.eye(3)
    return tuple(
        MappedSite(f"S{index:03d}", tip, covariance, np.zeros(3), 4.0, float(lat), TIME_SD_MS)
        for index, (tip, lat) in enumerate(zip(tips, times, strict=True))
    )


def score(truth: Truth, places: IntArray, sites: tuple[MappedSite, ...], chamber: ChamberMap) -> dict[str, float]:
    shown = chamber.covered
    areas = np.repeat(face_areas_mm2(chamber.vertices_mm, chamber.faces), 3)
    own: Array = np.bincount(chamber.faces.ravel(), areas, len(shown)).astype(np.float64)[shown]
    weight = own / own.sum()
    vertices = chamber.vertices_mm[shown]
    error = np.abs(chamber.lat_ms[shown] - truth.times_at(vertices))
    tips, times = np.array([site.tip_mm for site in sites]), np.array([site.lat_ms for site in sites])
    rbf = np.abs(RBFInterpolator(tips, times)(vertices) - truth.times_at(vertices))
    bare = volume_mm3(*hull_surface(tips)) / 1e3
    likely = np.cumsum([probability for _, probability in chamber.earliest])
    most = {site for site, _ in chamber.earliest[: int(np.searchsorted(likely, 0.9)) + 1]}
    first = sites[int(np.argmin(truth.lat_ms[places]))].site
    mapped = {site.site for site in chamber.sites if np.isfinite(site.distance_mm)}
    return {
        "error ms": _weighted_median(error, weight),
        "RBF ms": _weighted_median(rbf, weight),
        "in 95 %": float((weight * (error <= 1.959964 * chamber.lat_sd_ms[shown])).sum()),
        "first in set": float(first in most),
        "set": float(len(most)),
        "lost": float(len(sites) - len(mapped)),
        "bare lost": float(len(sites) - len(Hull(tips).vertices)),
        "volume": chamber.volume_ml / truth.volume_ml,
        "gap": abs(chamber.volume_ml - truth.volume_ml) / abs(bare - truth.volume_ml),
        "moved mm": float(np.mean([site.distance_mm for site in chamber.sites])),
        "covered": chamber.coverage,
        "kept out": float(len(sites) - sum(not site.reasons for site in chamber.sites)),
    }


def _weighted_median(values: Array, weight: Array) -> float:
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(weight[order]), 0.5)])


def _show(table: dict[str, list[dict[str, float]]]) -> None:
    """Print a line for each figure, a column for each setting and fuser."""
    headings = list(table)
    for line in zip(*(heading.split(", ") for heading in headings), strict=True):
        print(" " * 13 + "".join(f"{cell:>23}" for cell in line))
    for name in table[headings[0]][0]:
        cells = []
        for rows in table.values():
            mean, low, high = _interval(np.array([row[name] for row in rows]))
            cells.append(f"{mean:.3g} ({low:.3g}-{high:.3g})" if low < high else f"{mean:.3g}")
        print(f"{name:13}" + "".join(f"{cell:>23}" for cell in cells))


def _interval(values: Array) -> tuple[float, float, float]:
    drawn = np.random.default_rng(0).choice(values, (2000, len(values))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(values.mean()), float(low), float(high)


Placing = Callable[[Truth, int, np.random.Generator], IntArray]
SETTINGS: dict[str, tuple[Placing, float]] = {
    "spread, 0.7 mm": (spread, 0.7),
    "spread, 2 mm": (spread, 2.0),
    "scattered, 2 mm": (scattered, 2.0),
}


def main(first: int, chambers: int) -> None:
    """Print all tables, on seeds ``first`` to ``first + chambers - 1``."""
    print(
        f"{chambers} chambers from seed {first}, 20 sites with that noise per axis, times read to {TIME_SD_MS} ms; "
        "mean (95 % interval)"
    )
    table: dict[str, list[dict[str, float]]] = {}
    velocities: dict[int, list[tuple[float, float, float]]] = {60: [], 150: []}
    for seed in range(first, first + chambers):
        truth = draw_chamber(np.random.default_rng(seed))
        for setting, (placing, noise) in SETTINGS.items():
            rng = np.random.default_rng([seed, len(setting)])
            places = placing(truth, 20, rng)
            sites = sites_at(truth, places, noise, rng)
            for name in FUSERS:
                chamber = build_fuser(name, {}).fuse(sites, Silent())
                table.setdefault(f"{setting}, {name}", []).append(score(truth, places, sites, chamber))
        if seed < first + chambers // 4:
            for count, found in velocities.items():
                rng = np.random.default_rng([seed, count])
                sites = sites_at(truth, scattered(truth, count, rng), 0.7, rng)
                stated = build_fuser("smooth-surface", {}).fuse(sites, Silent()).conduction_velocity
                if stated is not None:
                    true = truth.velocity_m_per_s
                    found.append((stated.median_m_per_s / true, stated.low_m_per_s / true, stated.high_m_per_s / true))
    _show(table)
    for count, found in velocities.items():
        if found:
            ratio, low, high = np.array(found).T
            inside = np.mean((low <= 1) & (high >= 1))
            print(
                f"velocity, {count} scattered sites: stated in {len(found)} of {chambers // 4}, median over truth "
                f"{ratio.mean():.3f} (sd {ratio.std():.3f}), truth in the interval {inside:.2f}"
            )
    for name in FUSERS:
        for count in (20, 200):
            seconds, arrays, process = _cost(first, name, count)
            print(f"{name}, {count} sites: {seconds:.2f} s, {arrays:.0f} MB of arrays, {process:.0f} MB in all")
    _overlays(first)


def _overlays(seed: int) -> None:
    """Print the median time of an overlay of 20 sites, ms.

    The time includes drawing the map into a frame and encoding its PNG.
    """
    rng = np.random.default_rng(seed)
    truth = draw_chamber(rng)
    sites = sites_at(truth, spread(truth, 20, rng), 0.7, rng)
    chamber = build_fuser("smooth-surface", {}).fuse(sites, Silent())
    run = simulate_study(StudySpec(seed, sites=1, frames=1)).sites[0].runs[0]
    camera, frame = camera_from_gantry(run.gantry), (run.frames[0] >> 4).astype(np.uint8)
    to_isocentre = -chamber.vertices_mm.mean(axis=0)
    for scale in (1, 2):
        spent = []
        for _ in range(12):
            start = time.process_time()
            picture = draw_overlay(frame, camera, chamber, to_isocentre, sites[0].site, None, Look(scale=scale))
            drawn = time.process_time()
            encode_png(picture)
            spent.append((drawn - start, time.process_time() - drawn))
        drawing, encoding = 1000 * np.median(spent, axis=0)
        print(
            f"overlay at {scale} x {frame.shape[0]} px: {drawing + encoding:.0f} ms, {encoding:.0f} of them for the PNG"
        )


def _cost(seed: int, name: str, count: int) -> tuple[float, float, float]:
    """Return seconds and peak memory of a fuser.

    The memory is the peak MB of arrays, and the peak MB of a separate process that imports all plugins.
    """
    rng = np.random.default_rng(seed)
    truth = draw_chamber(rng)
    sites = sites_at(truth, spread(truth, count, rng), 0.7, rng)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_cost_here, (name, sites))


def _cost_here(name: str, sites: tuple[MappedSite, ...]) -> tuple[float, float, float]:
    fuser: Fuser = build_fuser(name, {})
    fuser.fuse(sites, Silent())
    start = time.process_time()
    fuser.fuse(sites, Silent())
    seconds = time.process_time() - start
    highest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    tracemalloc.start()
    fuser.fuse(sites, Silent())
    return seconds, tracemalloc.get_traced_memory()[1] / 1e6, highest


if __name__ == "__main__":
    given = [int(argument) for argument in sys.argv[1:]]
    main(*(given + [9000, 100][len(given) :]))
