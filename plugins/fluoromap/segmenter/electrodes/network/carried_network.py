"""What the network said about an earlier frame, carried along with the catheters that moved since."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.electrodes.network.network_response import NetworkEvidence
from fluoromap.segmenter.electrodes.proposals import Proposals


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How far catheters moved since an earlier frame.

    electrodes : their places now, n points in pixels. shifts_uv : since the earlier frame, (n, 2) pixels. near_px : how far from an
    electrode the image moves with it. Farther away it stands still.
    """

    electrodes: cKDTree
    shifts_uv: Array
    near_px: float

    def shifts_at(self, points_uv: Array) -> Array:
        """Return how far the image moved at points, (n, 2) pixels."""
        away, nearest = self.electrodes.query(points_uv)
        is_near = np.asarray(away)[:, None] <= self.near_px
        shifts: Array = np.where(is_near, self.shifts_uv[np.asarray(nearest)], 0.0)
        return shifts


@dataclass(frozen=True, slots=True, eq=False)
class CarriedNetwork:
    """Answers of the network to an earlier frame.

    See :class:`~fluoromap.segmenter.electrodes.network.network_response.NetworkResponse`.

    Points are asked about at the places that they had in the earlier frame.
    """

    earlier: NetworkEvidence
    motion: Motion

    def proposals(self, allowed: BoolArray, expected: int) -> Proposals:
        """Return the electrodes of the earlier frame."""
        return self.earlier.proposals(allowed, expected)

    def halves_of_pairs(self) -> Array:
        """Return the pairs of the earlier frame."""
        return self.earlier.halves_of_pairs()

    def tip_logits_at(self, points_uv: Array, reach_cells: int = 1) -> Array:
        """Return the logits of tip electrodes at points, (n,)."""
        return self.earlier.tip_logits_at(points_uv - self.motion.shifts_at(points_uv), reach_cells)

    def probability_at(self, points_uv: Array, reach_cells: int = 1) -> Array:
        """Return the highest probability of the cells within reach of each point, (n,)."""
        return self.earlier.probability_at(points_uv - self.motion.shifts_at(points_uv), reach_cells)

    def aims_at(self, points_uv: Array) -> Array:
        """Return the places to which the cells at points point, (n, 2) pixels."""
        shifts = self.motion.shifts_at(points_uv)
        aims: Array = self.earlier.aims_at(points_uv - shifts) + shifts
        return aims
