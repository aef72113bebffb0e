"""Activation times that the other sites contradict."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.distance import cdist

from fluoromap.contracts import Array, BoolArray
from fluoromap.fuser.activation_times import LeaveOneOut

LEAST_SITES_TO_JUDGE = 8
"""With fewer sites, only a time that no wave explains is an outlier."""

SLOWEST_MM_PER_MS = 0.5
"""A time that a wave of this speed or faster explains from the nearest site may be a focus; it is no outlier."""

NO_WAVE_MM_PER_MS = 0.2
"""No wave is slower than this over the straight distance between sites, not even through scar."""

LEAST_APART_MM = 10.0
"""Smallest distance with which sites are judged: 20 ms between neighbours is not yet a wrong annotation."""


def agreeing_sites(
    points_mm: Array,
    lat_ms: Array,
    outlier_sigma: float,
    difference: Callable[[Array, Array], Array],
    leave_one_out: Callable[[BoolArray], LeaveOneOut],
) -> BoolArray:
    """Return the sites (k,) that the others do not contradict.

    The worst site is removed first, then the next, at most a fifth of all sites (but at least one).

    Parameters
    ----------
    points_mm : (k, 3)
    lat_ms : (k,)
    outlier_sigma : float
        Largest deviation from the prediction of the others, in standard deviations.
    difference : callable
        Difference of two arrays of times; around the cycle where there is one.
    leave_one_out : callable
        Predicts each site in use (k,) from the other sites in use.
    """
    used = np.ones(len(lat_ms), dtype=np.bool_)
    apart = np.maximum(cdist(points_mm, points_mm), LEAST_APART_MM)
    between = np.abs(difference(lat_ms[:, None], lat_ms[None, :]))
    for _ in range(max(1, len(lat_ms) // 5)):
        indices = np.flatnonzero(used)
        own = np.ix_(indices, indices)
        if len(indices) > LEAST_SITES_TO_JUDGE:
            others = leave_one_out(used)
            error = np.abs(difference(lat_ms[used], others.predicted_ms))
            nearest = np.where(np.eye(len(indices), dtype=np.bool_), np.inf, apart[own]).min(axis=1)
            deviation = np.where(error <= nearest / SLOWEST_MM_PER_MS, 0.0, error / others.sd_ms)
            if deviation.max() <= outlier_sigma:
                break
            used[indices[int(np.argmax(deviation))]] = False
        else:
            alone = _alone(between[own], apart[own])
            if alone is None:
                break
            used[indices[alone]] = False
    return used


def _alone(between_ms: Array, apart_mm: Array) -> int | None:
    """Return the only site whose time no wave explains from any other site.

    The result is None without exactly one such site.
    """
    connected = between_ms <= apart_mm / NO_WAVE_MM_PER_MS
    np.fill_diagonal(connected, False)
    neighbours = connected.sum(axis=1)
    lonely = np.flatnonzero(neighbours == 0)
    return int(lonely[0]) if len(lonely) == 1 and len(between_ms) > 3 else None
