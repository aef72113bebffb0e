"""All ways to pair the catheters of one site across its views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.matching.pairs import GANTRY_SD_RAD, PairTable, student_cost

SHIFT_SD_MM = 6.0
"""Displacement of the heart across the epipolar lines between the runs: breathing, or a moved table."""
MISSING_COST = 18.0
"""Cost of a catheter of the catalogue without a pair: a pair that fits worse is none."""
_KEPT = 300
_WORTH_KEEPING = 30.0


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """The h ways to fill the s slots of the catalogue with pairs of chains.

    pairs : (h, s, 2) index of the chain in view a and in view b, -1 where the slot is empty.
    fixed_cost : (h,) the part of the cost that does not depend on the gantry.
    distance_px, variance_px2 : (h, s), NaN where empty.
    turn_px : (h, s, 3), as in :class:`~fluoromap.matching.pairs.PairTable`.
    position_mm : (h, s, 3), NaN where empty.
    shift_variance_px2 : variance of a common displacement by breathing.
    """

    pairs: IntArray
    fixed_cost: Array
    distance_px: Array
    variance_px2: Array
    turn_px: Array
    position_mm: Array
    shift_variance_px2: float

    def cost(self, turn_rad: Array, turn_covariance: Array) -> Array:
        """Return the cost (h,) of each hypothesis for a rotation of view b.

        The rotation against view a has a rotation vector (3,) and its covariance (3, 3).
        """
        chi2, count = self.offset_chi2(turn_rad, turn_covariance)
        cost: Array = self.fixed_cost + student_cost(chi2, count)
        return cost

    def offset_chi2(self, turn_rad: Array, turn_covariance: Array) -> tuple[Array, Array]:
        """Return the chi-squared (h,) of the epipolar distances, and their number.

        A displacement common to all catheters is subtracted: the heart breathed between the runs. It counts with its prior.
        """
        filled = self.pairs[:, :, 0] >= 0
        return offset_chi2(
            filled,
            self.distance_px,
            self.variance_px2,
            self.turn_px,
            self.shift_variance_px2,
            turn_rad,
            turn_covariance,
        )

    def subset(self, rows: IntArray) -> Hypotheses:
        """Return some of the hypotheses."""
        return Hypotheses(
            self.pairs[rows], self.fixed_cost[rows], self.distance_px[rows], self.variance_px2[rows],
            self.turn_px[rows], self.position_mm[rows], self.shift_variance_px2,
        )  # fmt: skip


def offset_chi2(
    filled: BoolArray,
    distance_px: Array,
    variance_px2: Array,
    turn_px: Array,
    shift_variance_px2: ArrayLike,
    turn_rad: Array,
    turn_covariance: Array,
) -> tuple[Array, Array]:
    """Return chi-squared and number of the epipolar distances of h hypotheses.

    See :meth:`Hypotheses.offset_chi2`. ``shift_variance_px2`` is one number, or one for each hypothesis.

    Parameters
    ----------
    filled : ndarray, shape (h, s)
    distance_px, variance_px2, turn_px, shift_variance_px2
        As in :class:`Hypotheses`.
    turn_rad, turn_covariance : ndarray, shape (3,), (3, 3)
    """
    distance = np.where(filled, distance_px - turn_px @ turn_rad, 0.0)
    spread = variance_px2 + np.einsum("hsi,ij,hsj->hs", turn_px, turn_covariance, turn_px)
    weight = np.where(filled, 1.0 / np.where(filled, spread, 1.0), 0.0)
    pull = (weight * distance).sum(axis=1)
    stiffness = 1.0 / np.asarray(shift_variance_px2) + weight.sum(axis=1)
    chi2: Array = (weight * distance**2).sum(axis=1) - pull**2 / stiffness
    return np.maximum(chi2, 0.0), filled.sum(axis=1)


PRIOR_TURN = (np.zeros(3), GANTRY_SD_RAD**2 * np.eye(3))
"""Prior rotation of view b against view a, before any evidence of the study."""


def enumerate_pairings(table: PairTable, slots: Sequence[int], px_per_mm: float) -> Hypotheses:
    """Return all likely pairings of a site's chains, the cheapest first.

    Parameters
    ----------
    table : PairTable
    slots : sequence of int
        Group of each catheter of the catalogue, slots of one group next to each other.
    px_per_mm : float
        Of view b at the isocentre.
    """
    n_b = table.possible.shape[1]
    cheapest = table.motion_cost.min(axis=2, initial=np.inf) if table.motion_cost.shape[2] else 0.0
    partial: list[tuple[float, tuple[int, ...]]] = [(0.0, ())]
    for number, group in enumerate(slots):
        cost = np.where(table.possible, table.shape_cost + table.group_cost[group] + cheapest, np.inf).ravel()
        fitting = [int(pair) for pair in np.flatnonzero(cost < 2 * MISSING_COST)]
        again = number > 0 and slots[number - 1] == group
        grown = []
        for so_far, chosen in partial:
            grown.append((so_far + MISSING_COST, (*chosen, -1)))
            for pair in fitting:
                # Slots of one group are filled in rising order: their names are decided elsewhere.
                if again and pair < chosen[-1]:
                    continue
                if any(k >= 0 and (k // n_b == pair // n_b or k % n_b == pair % n_b) for k in chosen):
                    continue
                if again and chosen[-1] < 0:
                    continue
                grown.append((so_far + float(cost[pair]), (*chosen, pair)))
        partial = sorted(grown)[:_KEPT]
    flat = np.array([chosen for _, chosen in partial], dtype=np.int64).reshape(len(partial), len(slots))
    empty = flat < 0
    i, j = np.where(empty, 0, flat // max(n_b, 1)), np.where(empty, 0, flat % max(n_b, 1))
    group_cost = table.group_cost[np.array(slots), i, j]
    fixed = np.where(empty, MISSING_COST, table.shape_cost[i, j] + group_cost).sum(axis=1)
    if table.motion_cost.shape[2]:
        fixed = fixed + np.where(empty[..., None], 0.0, table.motion_cost[i, j]).sum(axis=1).min(axis=1)
    found = Hypotheses(
        pairs=np.where(empty[..., None], -1, np.stack([i, j], axis=2)),
        fixed_cost=fixed,
        distance_px=np.where(empty, np.nan, table.distance_px[i, j]),
        variance_px2=np.where(empty, np.nan, table.variance_px2[i, j]),
        turn_px=np.where(empty[..., None], 0.0, table.turn_px[i, j]),
        position_mm=np.where(empty[..., None], np.nan, table.position_mm[i, j]),
        shift_variance_px2=(SHIFT_SD_MM * px_per_mm) ** 2,
    )
    cost = found.cost(*PRIOR_TURN)
    order = np.argsort(cost, kind="stable")
    return found.subset(order[cost[order] <= cost[order[0]] + _WORTH_KEEPING])
