"""What speaks against the two views of a site: a mirrored image, a wrong geometry, a catheter too many."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from fluoromap.contracts import IntArray
from fluoromap.geometry import Camera
from fluoromap.matching.hypotheses import MISSING_COST, PRIOR_TURN, SHIFT_SD_MM, Hypotheses
from fluoromap.matching.pairs import PairTable
from fluoromap.matching.run_catheters import RunCatheter

MIRRORED_SITE, MIRRORED_STUDY = 10.0, 15.0
"""A mirrored view must fit this much better (nats), at a site or over the study, to be believed."""
MIRRORED_MAYBE, MIRRORED_UNDECIDED = 5.0, -2.0
"""From here on, at a site or at the mean site of the study, it cannot be ruled out: the geometry is doubtful."""
DOUBTFUL_BELOW = 0.02
"""Probability of epipolar distances as large as this, below which the geometry is called doubtful. The tolerances are wide:
simulated studies with 1 degree of gantry error stay above 0.15."""
_CLEARLY_NOT = -3.0
_MISFIT = 12.0
_ASKEW = 3.5
_EXTRA_SEEN = 0.5
_EXTRA_APART_SD = 3.0


def mirror(camera: Camera) -> Camera:
    """The camera whose image is this one's with left and right exchanged: u becomes columns - 1 - u."""
    matrix = camera.matrix.copy()
    matrix[0] = (camera.columns - 1) * matrix[2] - matrix[0]
    return Camera(matrix, camera.rows, camera.columns)


def mirrored_gain(as_told: Hypotheses, mirrored: Sequence[Hypotheses]) -> float:
    """How much better (nats) the site's chains fit with one of its views mirrored; not above 0 unless they fit well then."""
    told = as_told.cost(*PRIOR_TURN)
    gains = []
    for one in mirrored:
        cost = one.cost(*PRIOR_TURN)
        best = int(np.argmin(cost))
        empty = int((one.pairs[best, :, 0] < 0).sum())
        gain = float(told.min() - cost[best])
        gains.append(gain if cost[best] - MISSING_COST * empty <= _MISFIT else min(gain, 0.0))
    return max(gains)


def mirrored_sites(gains: Sequence[float]) -> tuple[list[bool], list[bool]]:
    """Which sites have a mirrored view, and which of the others might.

    Those that say so clearly; where the study as a whole does, all but those that deny it. Catheters near the central rays
    look the same in the mirror, so that many sites say more than one.
    """
    study = sum(gains)
    mirrored = [gain > (_CLEARLY_NOT if study > MIRRORED_STUDY else MIRRORED_SITE) for gain in gains]
    undecided = study > MIRRORED_UNDECIDED * len(gains)
    maybe = [undecided or gain > MIRRORED_MAYBE for gain in gains]
    return mirrored, maybe


def gantry_angles(camera_a: Camera, camera_b: Camera) -> tuple[float, ...]:
    """What is equal for sites taken at the same gantry angles, to about a degree."""
    return tuple(np.round(np.concatenate([camera_a.axis_world, camera_b.axis_world]), 2) + 0.0)


def geometry_is_doubtful(table: PairTable, pairs: IntArray, px_per_mm: float) -> bool:
    """Whether the paired catheters (s, 2) lie farther from their epipolar lines than breathing and gantry explain, or
    stand askew to them, and not one alone."""
    i, j = pairs[pairs[:, 0] >= 0].T
    if not len(i):
        return False
    if len(i) > 1 and np.sort(table.shape_cost[i, j])[-2] > _ASKEW:
        return True
    turn = table.turn_px[i, j]
    spread = np.diag(table.variance_px2[i, j]) + (SHIFT_SD_MM * px_per_mm) ** 2 + turn @ PRIOR_TURN[1] @ turn.T
    distance = table.distance_px[i, j]
    return bool(chi2.sf(distance @ np.linalg.solve(spread, distance), len(i)) < DOUBTFUL_BELOW)


def groups_with_extra(
    table: PairTable,
    pairs: IntArray,
    slots: Sequence[int],
    catheters_a: Sequence[RunCatheter],
    catheters_b: Sequence[RunCatheter],
) -> list[int]:
    """Groups of look-alikes of which the site shows one more than the catalogue has.

    A chain left over in view a and one in view b, both seen through much of their runs, that would pair as well as the
    others do.
    """
    filled = pairs[pairs[:, 0] >= 0]
    if not len(filled):
        return []
    shift = float(np.median(table.distance_px[filled[:, 0], filled[:, 1]]))
    longest = [max(len(one.chains) for one in view) for view in (catheters_a, catheters_b)]
    found = []
    for i, first in enumerate(catheters_a):
        for j, second in enumerate(catheters_b):
            if i in filled[:, 0] or j in filled[:, 1] or not table.possible[i, j]:
                continue
            if min(len(first.chains) / max(longest[0], 1), len(second.chains) / max(longest[1], 1)) < _EXTRA_SEEN:
                continue
            turn = table.turn_px[i, j]
            spread = np.sqrt(table.variance_px2[i, j] + turn @ PRIOR_TURN[1] @ turn)
            motion = table.motion_cost[i, j].min(initial=np.inf) if table.motion_cost.shape[2] else 0.0
            cost = table.shape_cost[i, j] + table.group_cost[:, i, j] + motion
            if abs(table.distance_px[i, j] - shift) <= _EXTRA_APART_SD * spread and cost.min() <= MISSING_COST:
                found.append(int(np.argmin(cost)))
    # A group that is not full has a catheter missing, not one too many; it would have taken this one.
    full = {group for group in slots if all(pairs[k, 0] >= 0 for k, own in enumerate(slots) if own == group)}
    return sorted(set(found) & full)
