"""Doubts about a site's views: a mirrored image, a wrong geometry, an extra catheter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from fluoromap.contracts import IntArray
from fluoromap.geometry import Camera
from fluoromap.matching.hypotheses import MISSING_COST, PRIOR_TURN, SHIFT_SD_MM, Hypotheses
from fluoromap.matching.pairs import PairTable
from fluoromap.matching.run_catheters import CatheterFacts

MIRRORED_SITE, MIRRORED_STUDY = 10.0, 15.0
"""A mirrored view must fit this much better (nats), at a site or over the study, to be accepted."""
MIRRORED_MAYBE, MIRRORED_UNDECIDED = 5.0, -2.0
"""From this gain on, at a site or at the mean site of the study, a mirror cannot be ruled out: the geometry is doubtful."""
DOUBTFUL_BELOW = 0.02
"""Probability of epipolar distances as large as this, below which the geometry is doubtful.

The tolerances are wide: simulated studies with 1 degree of gantry error stay above 0.15.
"""
_CLEARLY_NOT = -3.0
_MISFIT = 12.0
_ASKEW = 3.5
_EXTRA_SEEN = 0.5
_EXTRA_APART_SD = 3.0


def mirror(camera: Camera) -> Camera:
    """Return the camera for the image with left and right exchanged.

    u becomes columns - 1 - u.
    """
    matrix = camera.matrix.copy()
    matrix[0] = (camera.columns - 1) * matrix[2] - matrix[0]
    return replace(camera, matrix=matrix)


def mirrored_gain(original: Hypotheses, mirrored: Sequence[Hypotheses]) -> float:
    """Return how much better (nats) the site's chains fit with one view mirrored.

    The gain is not above 0 unless they fit well then.
    """
    cost_of_original = original.cost(*PRIOR_TURN)
    gains = []
    for one in mirrored:
        cost = one.cost(*PRIOR_TURN)
        best = int(np.argmin(cost))
        empty = int((one.pairs[best, :, 0] < 0).sum())
        gain = float(cost_of_original.min() - cost[best])
        gains.append(gain if cost[best] - MISSING_COST * empty <= _MISFIT else min(gain, 0.0))
    return max(gains)


def mirrored_sites(gains: Sequence[float]) -> tuple[list[bool], list[bool]]:
    """Return which sites have a mirrored view, and which other sites might.

    A site is mirrored where its gain is clear. Where the gain of the whole study is clear, all sites are mirrored
    except those that clearly fit worse. Catheters near the central rays look the same in the mirror, so that many sites
    give more evidence than one.
    """
    study = sum(gains)
    mirrored = [gain > (_CLEARLY_NOT if study > MIRRORED_STUDY else MIRRORED_SITE) for gain in gains]
    undecided = study > MIRRORED_UNDECIDED * len(gains)
    maybe = [undecided or gain > MIRRORED_MAYBE for gain in gains]
    return mirrored, maybe


def gantry_angles(camera_a: Camera, camera_b: Camera) -> tuple[float, ...]:
    """Return a key of the gantry angles, rounded to about a degree."""
    return tuple(np.round(np.concatenate([camera_a.axis_world, camera_b.axis_world]), 2) + 0.0)


def geometry_is_doubtful(table: PairTable, pairs: IntArray, px_per_mm: float) -> bool:
    """Return whether the paired catheters (s, 2) contradict the geometry.

    They contradict it in two cases: they lie farther from their epipolar lines than breathing and gantry explain, or
    more than one of them lies askew to these lines.
    """
    i, j = pairs[pairs[:, 0] >= 0].T
    if not len(i):
        return False
    if len(i) > 1 and np.sort(table.shape_cost[i, j])[-2] > _ASKEW:
        return True
    turn = table.turn_px[i, j]
    spread = np.diag(table.variance_px2[i, j]) + (SHIFT_SD_MM * px_per_mm) ** 2 + turn @ PRIOR_TURN[1] @ turn.T
    distance = table.distance_px[i, j]
    return bool(chdtrc(len(i), distance @ np.linalg.solve(spread, distance)) < DOUBTFUL_BELOW)


def groups_with_extra(
    table: PairTable,
    pairs: IntArray,
    slots: Sequence[int],
    catheters_a: Sequence[CatheterFacts],
    catheters_b: Sequence[CatheterFacts],
) -> list[int]:
    """Return the groups of look-alikes of which the site shows one too many.

    The evidence is a chain of view a and a chain of view b that are not paired, are present in much of their runs, and
    would pair as well as the others.
    """
    filled = pairs[pairs[:, 0] >= 0]
    if not len(filled):
        return []
    shift = float(np.median(table.distance_px[filled[:, 0], filled[:, 1]]))
    longest = [max(one.frames for one in view) for view in (catheters_a, catheters_b)]
    found = []
    left_a, left_b = (
        [(index, one) for index, one in enumerate(view) if index not in used]
        for view, used in zip((catheters_a, catheters_b), filled.T.tolist(), strict=True)
    )
    for i, first in left_a:
        for j, second in left_b:
            if not table.possible[i, j]:
                continue
            if min(first.frames / max(longest[0], 1), second.frames / max(longest[1], 1)) < _EXTRA_SEEN:
                continue
            turn = table.turn_px[i, j]
            spread = np.sqrt(table.variance_px2[i, j] + turn @ PRIOR_TURN[1] @ turn)
            motion = table.motion_cost[i, j].min(initial=np.inf) if table.motion_cost.shape[2] else 0.0
            cost = table.shape_cost[i, j] + table.group_cost[:, i, j] + motion
            if abs(table.distance_px[i, j] - shift) <= _EXTRA_APART_SD * spread and cost.min() <= MISSING_COST:
                found.append(int(np.argmin(cost)))
    # A group that is not full lacks a catheter; it would have taken this chain.
    full = {group for group in slots if all(pairs[k, 0] >= 0 for k, own in enumerate(slots) if own == group)}
    return sorted(set(found) & full)
