"""Costs of pairing each chain of one view with each of the other, in nats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, BoolArray, Chain, IntArray
from fluoromap.geometry import Camera
from fluoromap.matching.numberings import Numbering, Way, readings
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
_OTHER_FIRST_COST = 3.0
"""Cost of numbers that begin at another electrode of a loop than the segmenter found, nats."""
_HOPELESS = 20.0
"""Numbers of a loop with which its distances from the epipolar lines cost so much more than with others are not tried."""


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
    turned, rotated : (n, m, 2), the :class:`~fluoromap.matching.numberings.Numbering` of the chain of view a and of that of
    view b. The other fields hold for these numbers.
    other_end_cost : (n, m), by how much the pair costs more with both chains numbered from the other end; infinite where that is
    no question. other_way_cost : (n, m), the same with one of the two numbered from its other end, or from another electrode of a
    loop.
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
    rotated: IntArray
    other_end_cost: Array
    other_way_cost: Array
    axis_mm: Array

    def way(self, pair: tuple[int, int]) -> Way:
        """Return how the two chains of a pair are numbered."""
        a, b = (
            Numbering(bool(turned), int(rotated))
            for turned, rotated in zip(self.turned[pair], self.rotated[pair], strict=True)
        )
        return a, b


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
        np.zeros((n, m, 2), dtype=np.int64), np.full((n, m), np.inf), np.full((n, m), np.inf), np.zeros((n, m, 3)),
    )  # fmt: skip
    votes_a, votes_b = (
        np.array([[one.vote(group) for group in groups] for one in catheters])
        for catheters in (catheters_a, catheters_b)
    )
    on_loop = np.array([catalogue[group[0]].is_circular for group in groups])
    found = [
        reading
        for i, first in enumerate(catheters_a)
        for j, second in enumerate(catheters_b)
        if not (first.manual_name and second.manual_name and first.manual_name != second.manual_name)
        for reading in readings((i, j), first, second, bool((on_loop & _is_voted(votes_a[i], votes_b[j])).any()))
    ]
    if not found:
        return table
    pixels_a = np.concatenate([catheters_a[one.pair[0]].diastole.pixels_uv[one.rows_a] for one in found])
    pixels_b = np.concatenate([catheters_b[one.pair[1]].diastole.pixels_uv[one.rows_b] for one in found])
    distances = signed_epipolar_px(*cameras, pixels_a, pixels_b)
    moved = np.stack(
        [signed_epipolar_px(cameras[0], _turned(cameras[1], axis), pixels_a, pixels_b) for axis in range(3)], axis=1
    )
    slopes = (moved - distances[:, None]) / _TURN_RAD
    points = triangulate_linear(*cameras, pixels_a, pixels_b)
    ends = np.cumsum([len(one.rows_a) for one in found])
    catheter_variance = (CATHETER_SD_MM * cameras[1].px_per_mm) ** 2
    noise_a, noise_b = ([_variances_px2(one.diastole) for one in catheters] for catheters in (catheters_a, catheters_b))
    costs: dict[tuple[int, int], dict[Way, float]] = {}
    least_uneven: dict[tuple[int, int], float] = {}
    for one, end in zip(found, ends, strict=True):
        own = slice(end - len(one.rows_a), end)
        i, j = one.pair
        first, second = catheters_a[i], catheters_b[j]
        noise = _PIXEL_FLOOR_PX**2 + noise_a[i][one.rows_a] + noise_b[j][one.rows_b]
        mean = common_distance(distances[own], noise)
        uneven = float(student_cost((distances[own] - mean) ** 2 / noise).sum())
        if one.is_rotated and uneven > least_uneven.get(one.pair, np.inf) + _HOPELESS:
            continue
        least_uneven[one.pair] = min(uneven, least_uneven.get(one.pair, np.inf))
        for way in one.ways:
            numbers = [way[0].number(number, first.electrodes) for number in one.numbers]
            at, electrodes = points[own][np.argsort(numbers)], sorted(numbers)
            shape = uneven + bend_cost(at)
            names = _name_costs(at, electrodes, np.stack([votes_a[i], votes_b[j]]), catalogue, groups)
            is_rotated = bool(way[0].rotated or way[1].rotated)
            if way[0].turned or is_rotated:
                whole = np.array([catalogue[group[0]].electrodes == first.electrodes for group in groups])
                names[~(whole & (on_loop | (not is_rotated)))] = np.inf
            by_group = _ends_cost(first, way[0]) + _ends_cost(second, way[1]) + names
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
                table.turned[i, j] = [numbering.turned for numbering in way]
                table.rotated[i, j] = [numbering.rotated for numbering in way]
                table.axis_mm[i, j] = at[0] - at[-1]
            known[way] = cost
    for pair, known in costs.items():
        if table.possible[pair] and len(known) > 1:
            chosen = table.way(pair)
            other_end = [way for way in known if all(a.turned != b.turned for a, b in zip(way, chosen, strict=True))]
            others = [way for way in known if way != chosen and way not in other_end]
            for cost_of, ways in ((table.other_end_cost, other_end), (table.other_way_cost, others)):
                cost_of[pair] = min((known[way] for way in ways), default=np.inf) - known[chosen]
    return table


def _is_voted(votes_a: Array, votes_b: Array) -> BoolArray:
    """Return which names (groups,) two chains with these votes may have."""
    voted: BoolArray = votes_a + votes_b >= 2 * LEAST_VOTE
    return voted


def _variances_px2(chain: Chain) -> Array:
    """Return the variance of a chain's electrodes along any direction, (m,)."""
    variances: Array = np.trace(chain.covariance_px2, axis1=1, axis2=2) / 2
    return variances


def _ends_cost(catheter: RunCatheter, numbering: Numbering) -> float:
    """Return the cost of these numbers against those that the segmenter found."""
    turned = catheter.tip_odds or 0.0 if numbering.turned else 0.0
    return turned + (_OTHER_FIRST_COST if numbering.rotated else 0.0)


def _name_costs(
    points_world_mm: Array,
    electrodes: Sequence[int],
    votes: Array,
    catalogue: Catalogue,
    groups: Sequence[tuple[str, ...]],
) -> Array:
    """Return the cost (groups,) of each name's spacings and votes (2, groups)."""
    costs: Array = -np.log(np.maximum(votes, 0.02)).sum(axis=0)
    costs[~_is_voted(*votes)] = np.inf
    for k in np.flatnonzero(np.isfinite(costs)).tolist():
        costs[k] += min(spacing_cost(points_world_mm, electrodes, catalogue[name]) for name in groups[k])
    return costs


def _turned(camera: Camera, axis: int) -> Camera:
    """Return the camera with the world rotated slightly about one of its axes."""
    c, s = np.cos(_TURN_RAD), np.sin(_TURN_RAD)
    first, second = [k for k in range(3) if k != axis] if axis != 1 else (2, 0)
    turn = np.eye(4)
    turn[first, first] = turn[second, second] = c
    turn[first, second], turn[second, first] = -s, s
    return camera.displaced(turn)
