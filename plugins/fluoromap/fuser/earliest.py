"""Sites that may be the earliest, with probabilities."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

from fluoromap.contracts import Array

LEAST_TOTAL = 0.99
"""Sites are listed until one of them is the earliest with this probability."""

_SURELY_LATER_SD = 9.0
"""Standard deviations beyond which a site is later than the earliest one: the probability of chance is 1e-19."""


def earliest_sites(names: tuple[str, ...], lat_ms: Array, lat_sd_ms: Array) -> tuple[tuple[str, float], ...]:
    """Return the sites one of which is the earliest with 99 %, most probable first.

    Times are independent and Gaussian: P(i) = integral of p_i(t) times the product over j of P(t_j > t) for j other than i.

    Parameters
    ----------
    names : (k,)
    lat_ms, lat_sd_ms : (k,)
        Times and their standard deviations, above 0.

    Returns
    -------
    tuple of (name, probability)
        The fewest sites that reach 99 % together; the probabilities are not scaled, so many small ones are not hidden.
    """
    times = np.linspace((lat_ms - 6 * lat_sd_ms).min(), (lat_ms + 6 * lat_sd_ms).min(), 4001)
    possible = np.flatnonzero(lat_ms - _SURELY_LATER_SD * lat_sd_ms <= times[-1])
    sd = lat_sd_ms[possible, None]
    z = (times - lat_ms[possible, None]) / sd
    log_later = log_ndtr(-z)
    others = log_later.sum(axis=0) - log_later
    share = np.exp(-0.5 * z**2 - np.log(sd) + others).sum(axis=1)
    share /= share.sum()
    order = np.argsort(-share, kind="stable")
    listed = order[: int(np.searchsorted(np.cumsum(share[order]), LEAST_TOTAL)) + 1]
    return tuple((str(names[possible[index]]), float(share[index])) for index in listed)
