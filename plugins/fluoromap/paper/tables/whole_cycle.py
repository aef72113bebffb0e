"""Simulated hearts over about a whole cardiac cycle from one view, for each solver."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fluoromap.contracts import Array, MonoplaneSolver, Refusal, Silent, Track
from fluoromap.paper.tables.phantom_runs import CYCLE_IMAGES, NOISE_PX, PhantomRun, PhantomView
from fluoromap.paper.tables.table2 import PHANTOM_VIEWS, Electrodes
from fluoromap.registry import build_monoplane

Scenario = Literal["breath held, own cycle", "breathing, own cycle", "breath held, cycles of other sites"]
Answer = Literal["a-priori-lm", "motion-prior baseline", "motion-prior"]

_GOOD_MM = 2.0


@dataclass(frozen=True, slots=True)
class WholeCycleRow:
    """3D RMS over a cycle, and its parts along and across the rays.

    The images are those after the a-priori image to the end of the cycle.
    refused : number of refused runs. They count in none of the figures, which are None where all runs are refused.
    relative_rms_mm : of positions minus the reference catheter's mean, without the reference catheter itself.
    largest_heart_rms_mm : of the worst heart. images_below_2_mm : number of the cycle's images with an RMS below 2 mm over
    all runs.
    """

    scenario: Scenario
    view: PhantomView
    electrodes: Electrodes
    solver: Answer
    noise_px: float
    images: int
    hearts: int
    runs: int
    refused: int
    rms_mm: float | None
    along_ray_mm: float | None
    lateral_mm: float | None
    relative_rms_mm: float | None
    largest_heart_rms_mm: float | None
    images_below_2_mm: int


@dataclass(frozen=True, eq=False)
class _Errors:
    """Errors (images, m, 3) of one run's track, mm, NaN without a position, and the true rays (images, m, 3)."""

    heart: int
    absolute: Array
    relative: Array
    rays: Array
    mapping: tuple[int, ...]


def whole_cycle_rows(scenario: Scenario, runs: Sequence[PhantomRun]) -> Iterator[tuple[WholeCycleRow, ...]]:
    """Track the runs by the paper's method (dz = 0) and ``motion-prior``; yield the rows of each view.

    Raises
    ------
    UnknownPlugin
        Where one of the two is not installed or does not load.
    """
    paper, prior = build_monoplane("a-priori-lm", {}), build_monoplane("motion-prior", {})
    for view in PHANTOM_VIEWS:
        found: dict[Answer, list[_Errors]] = {"a-priori-lm": [], "motion-prior baseline": [], "motion-prior": []}
        for run in (run.part(CYCLE_IMAGES) for run in runs if run.view == view):
            track = _track(paper, run)
            found["a-priori-lm"].append(_errors(run, track, None if track is None else track.positions_mm))
            track = _track(prior, run)
            found["motion-prior baseline"].append(_errors(run, track, None if track is None else track.baseline_mm))
            found["motion-prior"].append(_errors(run, track, None if track is None else track.positions_mm))
        yield tuple(
            _row(scenario, view, electrodes, solver, errors)
            for electrodes in ("12", "mapping")
            for solver, errors in found.items()
        )


def _track(solver: MonoplaneSolver, run: PhantomRun) -> Track | None:
    try:
        return solver.track(run.solver_input, Silent())
    except Refusal:
        return None


def _errors(run: PhantomRun, track: Track | None, positions_mm: Array | None) -> _Errors:
    absolute = np.full((len(run.truth_mm) - 1, len(run.electrodes), 3), np.nan)
    if track is not None and positions_mm is not None:
        absolute = np.where(track.located[..., None], positions_mm - run.truth_mm, np.nan)[1:]
    catheters = [name for name, _ in run.electrodes]
    reference = [name == run.solver_input.catalogue.reference for name in catheters]
    relative = absolute - absolute[:, reference].mean(axis=1, keepdims=True)
    relative[:, reference] = np.nan
    rays = run.truth_mm[1:] - run.solver_input.camera.source_world_mm
    rays = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    mapping = tuple(k for k, name in enumerate(catheters) if name == run.solver_input.catalogue.mapping)
    return _Errors(run.heart, absolute, relative, rays, mapping)


def _row(
    scenario: Scenario, view: PhantomView, electrodes: Electrodes, solver: Answer, errors: Sequence[_Errors]
) -> WholeCycleRow:
    def columns(run: _Errors) -> list[int]:
        return list(run.mapping) if electrodes == "mapping" else list(range(run.absolute.shape[1]))

    absolute = np.array([run.absolute[:, columns(run)] for run in errors])
    relative = np.array([run.relative[:, columns(run)] for run in errors])
    rays = np.array([run.rays[:, columns(run)] for run in errors])
    along = (absolute * rays).sum(axis=-1)
    lateral = absolute - along[..., None] * rays
    squares = (absolute**2).sum(axis=-1)
    hearts = np.array([run.heart for run in errors])
    by_heart = [_root_mean(squares[hearts == heart]) for heart in sorted(set(hearts.tolist()))]
    by_image = [_root_mean(squares[:, image]) for image in range(squares.shape[1])]
    return WholeCycleRow(
        scenario=scenario,
        view=view,
        electrodes=electrodes,
        solver=solver,
        noise_px=NOISE_PX,
        images=CYCLE_IMAGES,
        hearts=len(by_heart),
        runs=len(errors),
        refused=sum(bool(np.isnan(run.absolute).all()) for run in errors),
        rms_mm=_root_mean(squares),
        along_ray_mm=_root_mean(along**2),
        lateral_mm=_root_mean((lateral**2).sum(axis=-1)),
        relative_rms_mm=_root_mean((relative**2).sum(axis=-1)),
        largest_heart_rms_mm=max((rms for rms in by_heart if rms is not None), default=None),
        images_below_2_mm=sum(rms is not None and rms < _GOOD_MM for rms in by_image),
    )


def _root_mean(squares_mm2: Array) -> float | None:
    known = squares_mm2[np.isfinite(squares_mm2)]
    return float(np.sqrt(known.mean())) if known.size else None
