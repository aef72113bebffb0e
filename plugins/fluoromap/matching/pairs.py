"""Costs of pairing each chain of one view with each of the other, in nats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, BoolArray, Chain
from fluoromap.geometry import Camera
from fluoromap.matching.run_catheters import RunCatheter
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
    turned : (n, m, 2), whether the chain of view a and that of view b are numbered from the other end. The other fields hold for
    these numbers.
    other_end_cost : (n, m), by how much the pair costs more with both chains numbered from the other end; infinite where that is
    no question. one_end_cost : (n, m), the same with one of the two numbered from its other end.
    axis_mm : (n, m, 3), from the highest of the common electrodes to the lowest.
    """

    possible: BoolArray
    distance_px: Array
    variance_px2: Array
    turn_px: Array
    shape_cost: Array
    group_cost: Array
    motion_cost: Array
    position_mm: Array
    turned: BoolArray
    other_end_cost: Array
    one_end_cost: Array
    axis_mm: Array


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
    table = PairTable(
        np.zeros((n, m), dtype=np.bool_), np.zeros((n, m)), np.ones((n, m)), np.zeros((n, m, 3)), np.zeros((n, m)),
        np.full((len(groups), n, m), np.inf), motion_cost, np.zeros((n, m, 3)), np.zeros((n, m, 2), dtype=np.bool_),
        np.full((n, m), np.inf), np.full((n, m), np.inf), np.zeros((n, m, 3)),
    )  # fmt: skip
    readings = [
        reading
        for i, first in enumerate(catheters_a)
        for j, second in enumerate(catheters_b)
        if not (first.manual_name and second.manual_name and first.manual_name != second.manual_name)
        for reading in _readings((i, j), first, second)
    ]
    if not readings:
        return table
    pixels_a = np.concatenate([catheters_a[one.pair[0]].diastole.pixels_uv[one.rows_a] for one in readings])
    pixels_b = np.concatenate([catheters_b[one.pair[1]].diastole.pixels_uv[one.rows_b] for one in readings])
    distances = signed_epipolar_px(*cameras, pixels_a, pixels_b)
    moved = np.stack(
        [signed_epipolar_px(cameras[0], _turned(cameras[1], axis), pixels_a, pixels_b) for axis in range(3)], axis=1
    )
    slopes = (moved - distances[:, None]) / _TURN_RAD
    points = triangulate_linear(*cameras, pixels_a, pixels_b)
    ends = np.cumsum([len(one.rows_a) for one in readings])
    catheter_variance = (CATHETER_SD_MM * cameras[1].px_per_mm) ** 2
    noise_a, noise_b = ([_variances_px2(one.diastole) for one in catheters] for catheters in (catheters_a, catheters_b))
    votes_a, votes_b = (
        np.array([[one.vote(group) for group in groups] for one in catheters])
        for catheters in (catheters_a, catheters_b)
    )
    costs: dict[tuple[int, int], dict[tuple[bool, bool], float]] = {}
    for one, end in zip(readings, ends, strict=True):
        own = slice(end - len(one.rows_a), end)
        i, j = one.pair
        first, second = catheters_a[i], catheters_b[j]
        noise = _PIXEL_FLOOR_PX**2 + noise_a[i][one.rows_a] + noise_b[j][one.rows_b]
        mean = common_distance(distances[own], noise)
        uneven = float(student_cost((distances[own] - mean) ** 2 / noise).sum())
        shape = uneven + bend_cost(points[own])
        for ways in one.ways:
            at = points[own][::-1] if ways[0] else points[own]
            electrodes = [first.electrodes + 1 - number for number in reversed(one.numbers)] if ways[0] else one.numbers
            ends_cost = _ends_cost(first, ways[0]) + _ends_cost(second, ways[1])
            whole = first.electrodes if ways[0] else None
            names = _name_costs(at, electrodes, whole, np.stack([votes_a[i], votes_b[j]]), catalogue, groups)
            by_group = ends_cost + names
            cost = shape + float(by_group.min(initial=np.inf))
            known = costs.setdefault((i, j), {})
            if cost < min(known.values(), default=np.inf) or not known:
                table.distance_px[i, j] = mean
                table.variance_px2[i, j] = catheter_variance + 1 / (1 / noise).sum()
                table.turn_px[i, j] = slopes[own].mean(axis=0)
                table.position_mm[i, j] = points[own].mean(axis=0)
                table.shape_cost[i, j] = shape
                table.group_cost[:, i, j] = by_group
                table.possible[i, j] = bool(np.isfinite(by_group).any())
                table.turned[i, j] = ways
                table.axis_mm[i, j] = at[0] - at[-1]
            known[ways] = cost
    for (i, j), known in costs.items():
        in_a, in_b = (bool(way) for way in table.turned[i, j])
        if table.possible[i, j] and len(known) > 1:
            least = known[in_a, in_b]
            table.other_end_cost[i, j] = known.get((not in_a, not in_b), np.inf) - least
            one_end = [known.get(ways, np.inf) for ways in ((not in_a, in_b), (in_a, not in_b))]
            table.one_end_cost[i, j] = min(one_end) - least
    return table


@dataclass(frozen=True, slots=True)
class _Reading:
    """Two chains, electrode by electrode.

    numbers : of the common electrodes in view a. rows_a, rows_b : these electrodes in each chain. ways : which of the chains may be
    numbered from the other end so that these electrodes belong together.
    """

    pair: tuple[int, int]
    numbers: list[int]
    rows_a: list[int]
    rows_b: list[int]
    ways: tuple[tuple[bool, bool], ...]


def _variances_px2(chain: Chain) -> Array:
    """Return the variance of a chain's electrodes along any direction, (m,)."""
    variances: Array = np.trace(chain.covariance_px2, axis1=1, axis2=2) / 2
    return variances


def _readings(pair: tuple[int, int], first: RunCatheter, second: RunCatheter) -> list[_Reading]:
    """Return the ways in which two chains may show the same electrodes."""
    alike = first.electrodes == second.electrodes
    may_turn = [alike and one.tip_odds is not None for one in (first, second)]
    ways = [(a, b) for a in (False, True) for b in (False, True) if (may_turn[0] or not a) and (may_turn[1] or not b)]
    found = []
    for opposite in (False, True):
        own = tuple(way for way in ways if (way[0] != way[1]) == opposite)
        in_a, in_b = first.diastole.electrodes, second.diastole.electrodes
        partners = {number: second.electrodes + 1 - number if opposite else number for number in in_a}
        numbers = [number for number in in_a if partners[number] in in_b]
        if own and numbers:
            rows_a = [in_a.index(number) for number in numbers]
            rows_b = [in_b.index(partners[number]) for number in numbers]
            found.append(_Reading(pair, numbers, rows_a, rows_b, own))
    return found


def _ends_cost(catheter: RunCatheter, is_turned: bool) -> float:
    """Return the cost of numbering a catheter from its other end."""
    return catheter.tip_odds or 0.0 if is_turned else 0.0


def _name_costs(
    points_world_mm: Array,
    electrodes: Sequence[int],
    whole: int | None,
    votes: Array,
    catalogue: Catalogue,
    groups: Sequence[tuple[str, ...]],
) -> Array:
    """Return the cost (groups,) of each name's spacings and votes (2, groups).

    Names of catheters that do not have ``whole`` electrodes, where it is given, are impossible.
    """
    costs: Array = -np.log(np.maximum(votes, 0.02)).sum(axis=0)
    for k, group in enumerate(groups):
        if votes[0, k] + votes[1, k] >= 2 * LEAST_VOTE and whole in (None, catalogue[group[0]].electrodes):
            costs[k] += min(spacing_cost(points_world_mm, electrodes, catalogue[name]) for name in group)
        else:
            costs[k] = np.inf
    return costs


def _turned(camera: Camera, axis: int) -> Camera:
    """Return the camera with the world rotated slightly about one of its axes."""
    c, s = np.cos(_TURN_RAD), np.sin(_TURN_RAD)
    first, second = [k for k in range(3) if k != axis] if axis != 1 else (2, 0)
    turn = np.eye(4)
    turn[first, first] = turn[second, second] = c
    turn[first, second], turn[second, first] = -s, s
    return camera.displaced(turn)
