"""Limits that a chain has to reach to be accepted as a catheter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.chains.linking import ONE_BY_ONE, Trust
from fluoromap.segmenter.judge.features.dark_lines import IN_FRAME, DarkLineLimits
from fluoromap.segmenter.judge.visible_part import LEAST_VISIBLE
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

UNSEEN = 0.0
"""Score of an electrode outside the field: the others say where it is."""


def middle_score(scores: Array) -> Array:
    """Return the medians (...) of the scores (..., electrodes) that are not NaN.

    NumPy's own median takes several times as long for so few values.
    """
    if np.isnan(scores).any():
        return np.asarray(np.nanmedian(scores, axis=-1))
    ordered = np.sort(scores, axis=-1)
    count = scores.shape[-1]
    middle: Array = 0.5 * (ordered[..., (count - 1) // 2] + ordered[..., count // 2])
    return middle


@dataclass(frozen=True, slots=True)
class ScoreLimits:
    """Limits for the scores of a chain's electrodes, in the proposer's measure.

    middle : of their median. seen, least_seen : at least this share of the electrodes has this score.
    """

    middle: float
    seen: float = -np.inf
    least_seen: float = 0.0

    def allow(self, scores: Array) -> BoolArray:
        """Return which chains with scores (..., electrodes) reach the limits, (...).

        Electrodes outside the field have NaN and do not count.
        """
        share_seen = ((scores >= self.seen) | np.isnan(scores)).sum(axis=-1) / scores.shape[-1]
        allowed: BoolArray = (middle_score(scores) >= self.middle) & (share_seen >= self.least_seen)
        return allowed


@dataclass(frozen=True, slots=True)
class Acceptance:
    """How sure chains have to be, in the measures of one proposer.

    least_clearness, again_clearness : of :attr:`~fluoromap.segmenter.places.refinement.ElectrodeFit.clearness`, of a chain found in
    its image and of one of another frame. sure_clearness : one chain of an image has to reach it. extra_clearness : a catheter
    beside those of the catalogue is reported from here on. scores : limits for a chain. scores_beside : limits for a chain in
    an image that shows another catheter; the same by default. unseen_evidence : an electrode that was not proposed is predicted
    only where there is more :func:`~fluoromap.segmenter.chains.linking.evidence` than this. strict : a chain is not accepted as
    a catheter of the catalogue where sure proposals lie between its electrodes, or go on in its line. row_chain_score,
    row_score : a catheter of six or more electrodes is accepted without ``scores`` where its chain's score and the median of
    its scores are at least these and a pair is seen at both ends: anatomy rarely has so long a row with the right spacings, and
    a row that is displaced along its catheter ends where nothing is. hidden_pair : limits for such a catheter that does without
    a pair, which something may hide. trust : see :class:`~fluoromap.segmenter.chains.linking.Trust`. faded_price : if
    ``strict``, what the score of a chain of six or more loses for each place at its ends that shows no electrode. dark_lines :
    chains on such lines are not accepted, if ``strict``.
    """

    least_clearness: float
    again_clearness: float
    sure_clearness: float
    extra_clearness: float
    scores: ScoreLimits
    scores_beside: ScoreLimits | None = None
    unseen_evidence: float = 0.0
    strict: bool = False
    row_chain_score: float = np.inf
    row_score: float = np.inf
    hidden_pair: ScoreLimits = ScoreLimits(np.inf)
    trust: Trust = ONE_BY_ONE
    faded_price: float = 0.0
    dark_lines: DarkLineLimits = IN_FRAME

    def accepts(self, scores: Array, chain_scores: Array, beside: bool = False) -> BoolArray:
        """Return whether chains are clear enough, (...).

        Parameters
        ----------
        scores : (..., electrodes)
            Of the electrodes, in the proposer's measure; NaN outside the field.
        chain_scores : (...)
            Of the chains, see :func:`~fluoromap.segmenter.chains.linking.possible_chains`.
        beside : bool
            Whether the image shows another catheter.
        """
        limits = self.scores if self.scores_beside is None or not beside else self.scores_beside
        accepted = limits.allow(scores)
        if scores.shape[-1] >= MANY_ELECTRODES:
            unseen = np.isnan(scores)
            ends = np.where(unseen, np.inf, scores)
            ends = np.minimum(ends[..., :2].max(axis=-1), ends[..., -2:].max(axis=-1))
            clear = (chain_scores >= self.row_chain_score) & (middle_score(scores) >= self.row_score)
            accepted |= clear & (ends >= self.scores.seen)
        seen_enough: BoolArray = accepted & shows_enough(~np.isnan(scores))
        return seen_enough


def shows_enough(is_seen: BoolArray) -> BoolArray:
    """Return which chains have enough of their electrodes in the field, (...).

    All of a catheter with three electrodes or fewer, else three of them and half. is_seen : (..., electrodes).
    """
    electrodes = is_seen.shape[-1]
    enough: BoolArray = is_seen.sum(axis=-1) >= min(max(LEAST_VISIBLE, 0.5 * electrodes), electrodes)
    return enough
