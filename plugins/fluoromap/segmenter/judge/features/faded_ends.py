"""Ends of chains at which no electrodes are: a shorter catheter and its shaft must not pass for a longer catheter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.contracts import Array, IntArray
from fluoromap.segmenter.chains.families import CatheterFamily
from fluoromap.segmenter.chains.linking import PossibleChains
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

_FADED, _LEAST_CONTRAST = 0.5, 8.0
_LEAST_AT_END = 2
_EVEN_ODDS = 0.0


def without_shorter_catheters(
    possible: PossibleChains, families: Sequence[CatheterFamily], contrast: Array, odds: Array, price: float
) -> PossibleChains:
    """Return the likely chains that no catheter with fewer electrodes explains.

    A chain of six or more electrodes loses ``price`` of its score for each place at its ends that shows no electrode. It is left
    out where a shorter catheter of the catalogue has as many electrodes as the rest of the chain.

    Parameters
    ----------
    possible : PossibleChains
    families : sequence of CatheterFamily
        In the order of ``possible``.
    contrast : (n,)
        How much the candidates look like electrodes, in standard deviations of the noise.
    odds : (n,)
        Log-odds by which they differ from other blobs.
    price : float
        Infinite: chains with such places are left out.
    """
    lengths = [family.catheter.electrodes for family in families]
    allowed, all_scores = [], []
    likely = possible.where([np.isfinite(scores) for scores in possible.scores])
    for rows, scores, length in zip(likely.rows, likely.scores, lengths, strict=True):
        is_long = length >= MANY_ELECTRODES
        faded = count_faded(contrast[rows], odds[rows]) if is_long else np.zeros(len(rows), np.int64)
        shorter = max((other for other in lengths if other < length), default=0)
        allowed.append((faded == 0) | (length - faded > shorter))
        all_scores.append(scores - np.where(faded > 0, price * np.maximum(faded, 1), 0.0))
    return replace(likely, scores=tuple(all_scores)).where(allowed)


def count_faded(contrast: Array, odds: Array) -> IntArray:
    """Return how many places at the ends of each chain show no electrode, (n,).

    The electrodes of one catheter look alike. Places at an end, two or more, show none where they are improbable and have less
    than half of the others' contrast, although the noise would not hide that much. Both arguments are (n, electrodes).
    """
    faded = np.zeros(len(contrast), np.int64)
    for end in (slice(None), slice(None, None, -1)):
        improbable = odds[:, end][:, :_LEAST_AT_END].max(axis=1) < _EVEN_ODDS
        contrast_on, odds_on = contrast[improbable][:, end], odds[improbable][:, end]
        at_end = np.zeros(len(contrast_on), np.int64)
        for count in range(_LEAST_AT_END, contrast.shape[1] // 2 + 1):
            others = np.median(contrast_on[:, count:], axis=1)
            weak = contrast_on[:, :count].max(axis=1) < _FADED * others
            weak &= (others >= _LEAST_CONTRAST) & (odds_on[:, :count].max(axis=1) < _EVEN_ODDS)
            at_end[weak] = count
        faded[improbable] += at_end
    return faded
