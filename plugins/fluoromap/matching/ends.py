"""Which end of a catheter is its tip: what all sites of the study say together."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array, BoolArray

_SAME_LINE = 0.7
_CERTAIN = 50.0


def common_ends(axes_mm: Array, other_end_costs: Array) -> tuple[BoolArray, Array]:
    """Return at which sites a resting catheter is numbered from the wrong end.

    A catheter that rests lies alike at all sites. A site where it lies within 45 degrees of the same line or its reverse
    has a say about the others.

    Parameters
    ----------
    axes_mm : ndarray, shape (s, 3)
        From the last electrode to the first one, as each site numbers them.
    other_end_costs : ndarray, shape (s,)
        By how much the other end costs more at each site by itself, nats; negative where it costs less.

    Returns
    -------
    ndarray, shape (s,)
        Whether the other end is the tip.
    ndarray, shape (s,)
        By how much the remaining end costs more, 0 or more.
    """
    along = axes_mm / np.maximum(np.linalg.norm(axes_mm, axis=1, keepdims=True), 1e-9)
    cosine = along @ along.T
    same = np.where(np.abs(cosine) >= _SAME_LINE, np.sign(cosine), 0.0)
    np.fill_diagonal(same, 1.0)
    costs = same @ np.clip(other_end_costs, -_CERTAIN, _CERTAIN)
    return costs < 0, np.abs(costs)
