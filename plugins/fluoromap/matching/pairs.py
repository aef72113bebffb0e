"""Costs of pairing each chain of one view with each of the other, in nats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, BoolArray
from fluoromap.geometry import Camera
from fluoromap.matching.run_catheters import RunCatheter, common_electrodes
from fluoromap.matching.two_view import signed_epipolar_px, triangulate_linear

LEAST_VOTE = 0.15
"""A catheter does not get a name with a smaller vote."""
GANTRY_SD_RAD = np.radians(np.sqrt(2.0))
"""Rotation of one view against the other about each axis: 1 degree in each view."""
CATHETER_SD_MM = 0.6
"""Difference of a catheter's place between the runs: beat to beat, and another moment of the cycle."""
TAILS = 3.0
"""Degrees of freedom of the Student distributions, which replace normal ones where a few gross errors occur."""
_TURN_RAD = 1e-3
_PIXEL_FLOOR_PX = 0.8
_SPACING_SD_MM = 0.45
_BEND_SD_DEG = 35.0


@dataclass(frozen=True, eq=False)
class PairTable:
    """Every chain of view a (n of them) against every chain of view b (m).

    possible : (n, m), whether the two can be one catheter at all.
    distance_px : (n, m) mean signed epipolar distance of their electrodes.
    variance_px2 : (n, m) of that, for a correct gantry and the heart at one place in both runs.
    turn_px : (n, m, 3) its change for a rotation of view b about the world's axes by one radian.
    shape_cost : (n, m), for differences of the distance along the catheter and for bends that a catheter does not have.
    group_cost : (groups, n, m), spacing and votes; infinite where the name is impossible.
    motion_cost : (n, m, shifts) over the cycle, for each shift of view b's phases.
    position_mm : (n, m, 3), mean of the electrodes in the world.
    """

    possible: BoolArray
    distance_px: Array
    variance_px2: Array
    turn_px: Array
    shape_cost: Array
    group_cost: Array
    motion_cost: Array
    position_mm: Array


def student_cost(chi2: Array, terms: int | Array = 1) -> Array:
    """Return the negative logarithm of a Student density of ``terms`` numbers.

    chi2 : the sum of their squares over their variances.
    """
    cost: Array = (TAILS + terms) / 2 * np.log1p(chi2 / TAILS)
    return cost


def common_distance(distances: Array, variances: Array) -> float:
    """Return a weighted mean of distances (m,), robust against a few gross errors."""
    mean = float(np.median(distances))
    for _ in range(3):
        weights = (TAILS + 1) / (TAILS + (distances - mean) ** 2 / variances) / variances
        mean = float((weights * distances).sum() / weights.sum())
    return mean


def spacing_cost(points_world_mm: Array, electrodes: Sequence[int], catheter: Catheter) -> float:
    """Return the cost of the difference between measured and catalogue spacings.

    points_world_mm : (m, 3) of the electrodes with these numbers, ascending. The cost is 0 for one electrode, and
    infinite for more than the catheter has.
    """
    if electrodes[-1] > catheter.electrodes:
        return np.inf
    along = np.diff(catheter.arc_lengths_mm[np.array(electrodes) - 1])
    found = np.linalg.norm(np.diff(points_world_mm, axis=0), axis=1)
    return float(student_cost(((found - along) / _SPACING_SD_MM) ** 2).sum())


def bend_cost(points_world_mm: Array) -> float:
    """Return the cost of the bends of the line through points (m, 3)."""
    steps = np.diff(points_world_mm, axis=0)
    steps = steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9)
    cosine = np.clip((steps[1:] * steps[:-1]).sum(axis=1), -1.0, 1.0)
    return float(student_cost((np.degrees(np.arccos(cosine)) / _BEND_SD_DEG) ** 2).sum())


def pair_table(
    cameras: tuple[Camera, Camera],
    catheters_a: Sequence[RunCatheter],
    catheters_b: Sequence[RunCatheter],
    motion_cost: Array,
    catalogue: Catalogue,
    groups: Sequence[tuple[str, ...]],
) -> PairTable:
    """Compare all chains of a site's two runs at diastole.

    ``motion_cost`` compares them over the cycle, see :func:`~fluoromap.matching.phase_matching.motion_misfit`.
    """
    n, m = len(catheters_a), len(catheters_b)
    shared = {}
    for i, first in enumerate(catheters_a):
        for j, second in enumerate(catheters_b):
            if first.manual_name and second.manual_name and first.manual_name != second.manual_name:
                continue
            in_a, in_b = common_electrodes(first.diastole, second.diastole)
            if in_a:
                shared[i, j] = (in_a, in_b)
    table = PairTable(
        np.zeros((n, m), dtype=np.bool_), np.zeros((n, m)), np.ones((n, m)), np.zeros((n, m, 3)), np.zeros((n, m)),
        np.full((len(groups), n, m), np.inf), motion_cost, np.zeros((n, m, 3)),
    )  # fmt: skip
    if not shared:
        return table
    pixels_a = np.concatenate([catheters_a[i].diastole.pixels_uv[rows] for (i, _), (rows, _) in shared.items()])
    pixels_b = np.concatenate([catheters_b[j].diastole.pixels_uv[rows] for (_, j), (_, rows) in shared.items()])
    distances = signed_epipolar_px(*cameras, pixels_a, pixels_b)
    turned = np.stack(
        [signed_epipolar_px(cameras[0], _turned(cameras[1], axis), pixels_a, pixels_b) for axis in range(3)], axis=1
    )
    slopes = (turned - distances[:, None]) / _TURN_RAD
    points = triangulate_linear(*cameras, pixels_a, pixels_b)
    ends = np.cumsum([len(rows) for rows, _ in shared.values()])
    catheter_variance = (CATHETER_SD_MM * cameras[1].px_per_mm) ** 2
    for ((i, j), (in_a, in_b)), end in zip(shared.items(), ends, strict=True):
        own = slice(end - len(in_a), end)
        first, second = catheters_a[i], catheters_b[j]
        noise = _PIXEL_FLOOR_PX**2 + sum(
            np.trace(chain.covariance_px2[rows], axis1=1, axis2=2) / 2
            for chain, rows in ((first.diastole, in_a), (second.diastole, in_b))
        )
        mean = common_distance(distances[own], noise)
        table.distance_px[i, j] = mean
        table.variance_px2[i, j] = catheter_variance + 1 / (1 / noise).sum()
        table.turn_px[i, j] = slopes[own].mean(axis=0)
        table.position_mm[i, j] = points[own].mean(axis=0)
        uneven = float(student_cost((distances[own] - mean) ** 2 / noise).sum())
        table.shape_cost[i, j] = uneven + bend_cost(points[own])
        electrodes = [first.diastole.electrodes[row] for row in in_a]
        for k, group in enumerate(groups):
            spacing = min(spacing_cost(points[own], electrodes, catalogue[name]) for name in group)
            votes = np.array([one.vote(group) for one in (first, second)])
            if votes.mean() >= LEAST_VOTE:
                table.group_cost[k, i, j] = spacing - np.log(np.maximum(votes, 0.02)).sum()
        table.possible[i, j] = bool(np.isfinite(table.group_cost[:, i, j]).any())
    return table


def _turned(camera: Camera, axis: int) -> Camera:
    """Return the camera with the world rotated slightly about one of its axes."""
    c, s = np.cos(_TURN_RAD), np.sin(_TURN_RAD)
    first, second = [k for k in range(3) if k != axis] if axis != 1 else (2, 0)
    turn = np.eye(4)
    turn[first, first] = turn[second, second] = c
    turn[first, second], turn[second, first] = -s, s
    return camera.displaced(turn)
