"""Table 2: simulated hearts in the paper's design, through the paper's method and as one rigid body."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fluoromap.contracts import Array, Refusal, Silent
from fluoromap.monoplane.body_pose import pose_covariance_mm2
from fluoromap.paper.tables.depth_figures import DepthFigures, depth_figures
from fluoromap.paper.tables.phantom_runs import CYCLE_IMAGES, NOISE_PX, PhantomRun, PhantomView
from fluoromap.paper.tables.published import DEPTH_STEPS_MM, IMAGES, table_2_rms_over_mean
from fluoromap.registry import build_monoplane

Electrodes = Literal["12", "mapping"]
"""All 12 electrodes, or the four of the mapping catheter."""

PHANTOM_VIEWS: tuple[PhantomView, ...] = ("LAT", "PA")
_IMAGES = (min(IMAGES), max(IMAGES))


@dataclass(frozen=True, slots=True)
class Table2Row:
    """A row of Table 2.

    electrodes : all 12, or the tip of the mapping catheter alone. paper : None, because its figures are not known here.
    paper_rms_over_mean : of the 12 electrodes, known only for dz = 5 mm.
    """

    view: PhantomView
    electrodes: Literal["12", "mapping tip"]
    dz_mm: int
    images: int
    paper: DepthFigures | None
    ours: DepthFigures
    paper_rms_over_mean: float | None
    ours_rms_over_mean: float


@dataclass(frozen=True, slots=True)
class RigidPhantomRow:
    """Runs of hearts as one rigid body.

    electrodes : all 12, or the mapping catheter alone. bound_mm : RMS Cramer-Rao bound of a rigid body. rms_mm : over the
    runs that were not refused; None where all were. refused : number of refused runs. reason, example : their most frequent
    reason code and its first message.
    """

    view: PhantomView
    electrodes: Electrodes
    noise_px: float
    images: int
    runs: int
    refused: int
    reason: str | None
    example: str | None
    rms_mm: float | None
    bound_mm: float


def table2(runs: Sequence[PhantomRun]) -> tuple[Table2Row, ...]:
    """Return Table 2 over the given runs, from the diastolic image on."""
    rows: list[Table2Row] = []
    for view in PHANTOM_VIEWS:
        shown = [run.part(max(_IMAGES)) for run in runs if run.view == view]
        axes = [run.solver_input.camera.axis_world for run in shown]
        for dz in DEPTH_STEPS_MM:
            solver = build_monoplane("a-priori-lm", {"depth_step_mm": dz})
            errors = [solver.track(run.solver_input, Silent()).positions_mm - run.truth_mm for run in shown]
            of_tip = [error[:, _tip(run)] for error, run in zip(errors, shown, strict=True)]
            for images in _IMAGES:
                figures = depth_figures([error[:images] for error in errors], axes)
                ratio = figures.rms_mm / figures.mean_mm
                paper = table_2_rms_over_mean(view, dz, images)
                rows.append(Table2Row(view, "12", dz, images, None, figures, paper, ratio))
                figures = depth_figures([error[:images] for error in of_tip], axes)
                ratio = figures.rms_mm / figures.mean_mm
                rows.append(Table2Row(view, "mapping tip", dz, images, None, figures, None, ratio))
    return tuple(sorted(rows, key=lambda row: (row.view, row.electrodes, row.dz_mm, row.images)))


def _tip(run: PhantomRun) -> list[int]:
    return [run.electrodes.index((run.solver_input.catalogue.mapping, 1))]


def rigid_phantom_rows(runs: Sequence[PhantomRun]) -> tuple[RigidPhantomRow, ...]:
    """Track the runs by ``rigid-pose``: 3 and 6 images, and a whole cycle."""
    rows = []
    for view in PHANTOM_VIEWS:
        shown = [run for run in runs if run.view == view]
        mapping_alone = [run.of_catheter(run.solver_input.catalogue.mapping) for run in shown]
        lengths = (*_IMAGES, CYCLE_IMAGES)
        rows += [_rigid(view, "12", images, [run.part(images) for run in shown]) for images in lengths]
        rows += [_rigid(view, "mapping", images, [run.part(images) for run in mapping_alone]) for images in lengths]
    return tuple(rows)


def _rigid(view: PhantomView, electrodes: Electrodes, images: int, runs: Sequence[PhantomRun]) -> RigidPhantomRow:
    refusals: list[Refusal] = []
    squares: list[float] = []
    for run in runs:
        try:
            track = build_monoplane("rigid-pose", {}).track(run.solver_input, Silent())
        except Refusal as refusal:
            refusals.append(refusal)
        else:
            off = ((track.positions_mm - run.truth_mm) ** 2).sum(axis=2)[1:]
            squares.append(float(off[track.located[1:]].mean()))
    reason = Counter(refusal.reason for refusal in refusals).most_common(1)[0][0] if refusals else None
    example = next((str(refusal) for refusal in refusals if refusal.reason is reason), None)
    bound = np.sqrt(np.mean([_bound_mm2(run) for run in runs]))
    rms = float(np.sqrt(np.mean(squares))) if squares else None
    return RigidPhantomRow(
        view, electrodes, NOISE_PX, images, len(runs), len(refusals), reason, example, rms, float(bound)
    )


def _bound_mm2(run: PhantomRun) -> float:
    """Return the mean square of the Cramer-Rao bound of the electrodes in the first image."""
    points: Array = run.truth_mm[0]
    noise = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(points), 2, 2))
    visible = np.ones(len(points), dtype=np.bool_)
    covariance = pose_covariance_mm2(run.solver_input.camera, points, points.mean(axis=0), noise, visible)
    return float(np.trace(covariance, axis1=1, axis2=2).mean())
