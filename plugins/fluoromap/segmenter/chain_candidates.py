"""Candidates for the electrodes of chains: proposals, middles of long tips, electrodes of split pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.linking import CatheterFamily, PossibleChains
from fluoromap.segmenter.long_tips import TipMiddles, are_ends_of_tip
from fluoromap.segmenter.proposals import ImageEvidence, Proposals

_LEAST_PLACES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Candidates of one image, in this order: proposals, electrodes of split pairs, middles of long tips."""

    proposals: Proposals
    halves: Proposals
    middles: TipMiddles

    @property
    def single(self) -> Proposals:
        """The candidates for electrodes of every kind: proposals and electrodes of split pairs."""
        return self.proposals.with_more(self.halves)

    @property
    def together(self) -> Proposals:
        """All candidates, in their order."""
        return self.single.with_more(self.middles.proposals)

    @property
    def tip_middles(self) -> range:
        """The indices of the middles."""
        return range(len(self.single), len(self.single) + len(self.middles))

    def scores_at(self, seen: ImageEvidence, points_uv: Array) -> Array:
        """Return the scores of points of which the first are these candidates, (n,).

        A middle has at least the score of the weaker end of its tip.
        """
        scores: Array = np.array(seen.scores_at(points_uv))
        middles = list(self.tip_middles)
        scores[middles] = np.maximum(scores[middles], scores[self.middles.ends].min(axis=1))
        return scores

    def possible(self, chains: PossibleChains, points_uv: Array, families: Sequence[CatheterFamily]) -> PossibleChains:
        """Return the chains in which each candidate can be what it is.

        A middle is the first electrode of a chain. The tip's ends are no other electrodes of it, and lie as its next electrode
        demands. A chain shows at least four separate places: two electrodes of split pairs are one place. Three drops of contrast
        medium may lie like a pair and two rings.
        """
        first_half = len(self.proposals)
        first_middle = first_half + len(self.halves)
        last = first_middle + len(self.middles)
        allowed: list[BoolArray] = []
        for family, rows in zip(families, chains.rows, strict=True):
            halves = np.count_nonzero((rows >= first_half) & (rows < first_middle), axis=1)
            is_middle = (rows >= first_middle) & (rows < last)
            fits: BoolArray = np.logical_not(is_middle[:, 1:].any(axis=1))
            with_middle = np.flatnonzero(fits & is_middle[:, 0])
            ends = self.middles.ends[rows[with_middle, 0] - first_middle]
            once = ~(rows[with_middle][:, :, None] == ends[:, None]).any(axis=(1, 2))
            first_gap = points_uv[rows[with_middle, 1]] - points_uv[rows[with_middle, 0]]
            apart = points_uv[ends[:, 1]] - points_uv[ends[:, 0]]
            fits[with_middle] = once & are_ends_of_tip(apart, first_gap, family.catheter)
            allowed.append(fits & (halves <= 2 * max(rows.shape[1] - _LEAST_PLACES, 0)))
        return chains.where(allowed)
