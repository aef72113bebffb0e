"""Ends of chains at which no electrodes are: a shorter catheter and its shaft must not pass for a longer catheter."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array, IntArray

_FADED, _LEAST_CONTRAST = 0.5, 8.0
_LEAST_AT_END = 2
_EVEN_ODDS = 0.0


def count_faded(contrast: Array, odds: Array) -> IntArray:
    """Return how many places at the ends of each chain show no electrode, (n,).

    The electrodes of one catheter look alike. Places at an end, two or more, show none where they are improbable and have less
    than half of the others' contrast, although the noise would not hide that much.

    Parameters
    ----------
    contrast : (n, electrodes)
        How much the places look like electrodes, in standard deviations of the noise.
    odds : (n, electrodes)
        Log-odds by which they differ from other blobs.
    """
    faded = np.zeros(len(contrast), np.int64)
    for end in (slice(None), slice(None, None, -1)):
        contrast_on, odds_on = contrast[:, end], odds[:, end]
        longest = np.zeros(len(contrast), np.int64)
        for count in range(_LEAST_AT_END, contrast.shape[1] // 2 + 1):
            others = np.median(contrast_on[:, count:], axis=1)
            weak = contrast_on[:, :count].max(axis=1) < _FADED * others
            weak &= (others >= _LEAST_CONTRAST) & (odds_on[:, :count].max(axis=1) < _EVEN_ODDS)
            longest[weak] = count
        faded += longest
    return faded
