"""Two-view triangulation against its limits: ``python benchmarks/triangulation.py [first seed] [hearts]``.

The first table gives the 3D RMS over the Cramer-Rao bound (sigma 0.5 px, 20 000 points within 35 mm of the isocentre) at
several angles between the views, and points a second of processor time. OpenCV's ``triangulatePoints`` runs beside it where
installed.

The second table gives self-calibration: 20 sites of simulated hearts at rest, 12 electrodes each, 0.5 px noise. View b's true
camera is rotated about the isocentre and shifted against its header. Figures are means over hearts; ``aligned`` is after the
best rigid alignment. ``benchmarks/ellipsoid_coverage.py`` has hearts that beat and breathe between the runs.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue
from fluoromap.contracts import MatchedRuns, MatchedSite, NamedChain, Observation, PhasePair, Silent, Triangulation
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.matching.two_view import triangulate_linear
from fluoromap.phantom import FRONTAL, LATERAL, SimulatedStudy, StudySpec, simulate_study
from fluoromap.triangulator.estimate import triangulate_maximum_likelihood
from fluoromap.triangulator.maximum_likelihood import MaximumLikelihood
from fluoromap.triangulator.uncertainty import UncertaintyParams

Array = NDArray[np.float64]

NOISE_PX = 0.5
SITES = 20
POINTS = 20_000


def camera(primary_deg: float) -> Camera:
    return camera_from_gantry(Gantry(primary_deg, 0.0, 1000.0, 500.0, (178 / 512, 178 / 512), 512, 512))


def bound_mm(cameras: tuple[Camera, Camera], points: Array) -> float:
    """Return the RMS Cramer-Rao bound of points (n, 3)."""
    jacobian = np.concatenate([one.jacobian(points) for one in cameras], axis=1)
    information = np.einsum("nki,nkj->nij", jacobian, jacobian) / NOISE_PX**2
    return float(np.sqrt(np.trace(np.linalg.inv(information), axis1=1, axis2=2).mean()))


def angles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-35, 35, (POINTS, 3))
    noise = np.broadcast_to(NOISE_PX**2 * np.eye(2), (POINTS, 2, 2))
    methods: dict[str, Callable[[Camera, Camera, Array, Array], Array]] = {
        "linear": triangulate_linear,
        "maximum-likelihood": lambda a, b, p, q: triangulate_maximum_likelihood(a, b, p, q, noise, noise),
    }
    opencv = _opencv()
    if opencv is not None:
        methods[f"OpenCV {opencv.__version__}"] = lambda a, b, p, q: _homogeneous(
            opencv.triangulatePoints(a.matrix, b.matrix, np.ascontiguousarray(p.T), np.ascontiguousarray(q.T))
        )
    print(f"{'angle':>6}{'bound mm':>10}" + "".join(f"{name:>34}" for name in methods))
    print(f"{'':16}" + "".join(f"{'RMS/bound   1000 points/s':>34}" for _ in methods))
    for angle in (90, 75, 60, 45, 30, 20):
        cameras = camera(float(angle)), camera(0.0)
        a, b = (one.project(points) + rng.normal(0, NOISE_PX, (POINTS, 2)) for one in cameras)
        bound, cells = bound_mm(cameras, points), []
        for locate in methods.values():
            start = time.process_time()
            found = locate(*cameras, a, b)
            seconds = time.process_time() - start
            rms = float(np.sqrt(((found - points) ** 2).sum(axis=1).mean()))
            cells.append(f"{rms / bound:.4f}   {POINTS / seconds / 1000:13.0f}")
        print(f"{angle:6}{bound:10.3f}" + "".join(f"{cell:>34}" for cell in cells))


def _opencv() -> Any:
    try:
        return importlib.import_module("cv2")
    except ImportError:
        return None


def _homogeneous(points: Array) -> Array:
    finite: Array = (points[:3] / points[3]).T
    return finite


def calibration(first_seed: int, hearts: int) -> None:
    print(
        f"\n{'view b against its header':34}{'header: abs  aligned  epipolar':>34}"
        f"{'calibrated: abs  aligned  epipolar':>38}{'applied':>9}"
    )
    longer = _wrong_catalogue()
    rows = [
        ("right", 0.0, 0.0, DEFAULT_CATALOGUE),
        ("0.5 deg", 0.5, 0.0, DEFAULT_CATALOGUE),
        ("1 deg", 1.0, 0.0, DEFAULT_CATALOGUE),
        ("2 mm", 0.0, 2.0, DEFAULT_CATALOGUE),
        ("1 deg, 2 mm", 1.0, 2.0, DEFAULT_CATALOGUE),
        ("right, spacing 2 mm wrong", 0.0, 0.0, longer),
        ("1 deg, 2 mm, spacing 2 mm wrong", 1.0, 2.0, longer),
    ]
    studies = [
        simulate_study(StudySpec(seed, sites=SITES, frames=1)) for seed in range(first_seed, first_seed + hearts)
    ]
    for name, angle_deg, offset_mm, catalogue in rows:
        print(_calibration_row(name, studies, angle_deg, offset_mm, catalogue), flush=True)


def _wrong_catalogue() -> Catalogue:
    """Return a catalogue whose mapping catheter has a middle gap 2 mm too long."""
    mapping = DEFAULT_CATALOGUE["mapping"]
    first, second, third = mapping.spacing_mm
    wrong = replace(mapping, spacing_mm=(first, second + 2.0, third))
    others = tuple(one for one in DEFAULT_CATALOGUE.catheters if one.name != "mapping")
    return replace(DEFAULT_CATALOGUE, catheters=(*others, wrong))


def _calibration_row(
    name: str, studies: list[SimulatedStudy], angle_deg: float, offset_mm: float, catalogue: Catalogue
) -> str:
    figures = []
    for study in studies:
        rng = np.random.default_rng([study.spec.seed, 7])
        sites, truth = still_sites(study, angle_deg, offset_mm, rng)
        located = MaximumLikelihood(UncertaintyParams()).triangulate(sites, catalogue, Silent())
        assert located.calibration is not None
        header = np.concatenate(
            [triangulate_linear(site.runs.camera_a, site.runs.camera_b, *_pixels(site)) for site in sites]
        )
        found = _positions(located)
        figures.append([
            _rms(header - truth), _rms(_aligned(header, truth) - truth), located.calibration.epipolar_before_px,
            _rms(found - truth), _rms(_aligned(found, truth) - truth), located.calibration.epipolar_after_px,
            float(located.calibration.applied),
        ])  # fmt: skip
    a, b, c, d, e, f, g = np.mean(figures, axis=0)
    return f"{name:34}{a:16.3f}{b:9.3f}{c:9.2f}{d:20.3f}{e:9.3f}{f:9.2f}{g:9.2f}"


def still_sites(
    study: SimulatedStudy, angle_deg: float, offset_mm: float, rng: np.random.Generator
) -> tuple[tuple[MatchedSite, ...], Array]:
    """Return all sites at diastole, and their true points.

    Both views show the same moment; the true camera of view b differs from its header.
    """
    turn, offset = rng.normal(size=3), rng.normal(size=3)
    displaced = np.eye(4)
    displaced[:3, :3] = Rotation.from_rotvec(angle_deg * turn / np.linalg.norm(turn), degrees=True).as_matrix()
    displaced[:3, 3] = offset_mm * offset / np.linalg.norm(offset)
    cameras = camera_from_gantry(LATERAL), camera_from_gantry(FRONTAL)
    true = cameras[0], Camera(cameras[1].matrix @ displaced, 512, 512)
    sites, truth = [], []
    for site in study.sites:
        points = site.truth.diastole_mm
        a, b = (_observation(one, points, rng) for one in true)
        runs = MatchedRuns(*cameras, PhasePair(0.8, a, b), (), (a,), (b,), np.zeros(1), np.zeros(1))
        sites.append(MatchedSite(site.name, runs))
        truth.append(np.concatenate([points[name] for name in points]))
    return tuple(sites), np.concatenate(truth)


def _observation(camera: Camera, points: Any, rng: np.random.Generator) -> Observation:
    chains = tuple(
        NamedChain(
            name,
            tuple(range(1, len(at) + 1)),
            camera.project(at) + rng.normal(0, NOISE_PX, (len(at), 2)),
            np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(at), 2, 2)),
        )
        for name, at in points.items()
    )
    return Observation(0, 0.8, chains)


def _pixels(site: MatchedSite) -> tuple[Array, Array]:
    views = site.runs.diastole.a, site.runs.diastole.b
    a, b = (np.concatenate([chain.pixels_uv for chain in view.chains]) for view in views)
    return a, b


def _positions(located: Triangulation) -> Array:
    return np.array([point.position_mm for site in located.sites for point in site.points])


def _aligned(points: Array, truth: Array) -> Array:
    middle, centre = points.mean(axis=0), truth.mean(axis=0)
    rotation, _ = Rotation.align_vectors(truth - centre, points - middle)
    aligned: Array = rotation.apply(points - middle) + centre
    return aligned


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def main(first_seed: int, hearts: int) -> None:
    angles(first_seed)
    calibration(first_seed, hearts)


if __name__ == "__main__":
    words = [int(word) for word in sys.argv[1:]]
    main(*(*words, *(9000, 12)[len(words) :]))
