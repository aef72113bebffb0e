"""Sites that may be the earliest, with probabilities."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

from fluoromap.contracts import Array

LEAST_PROBABILITY = 0.01
"""Sites less probable than this are left out; the others share their probability."""


def earliest_sites(names: tuple[str, ...], lat_ms: Array, lat_sd_ms: Array) -> tuple[tuple[str, float], ...]:
    """Return the sites that may be the earliest, most probable first, down to 1 %.

    Times are independent and Gaussian: P(i) = integral of p_i(t) times the product over j of P(t_j > t) for j other than i.

    Parameters
    ----------
    names : (k,)
    lat_ms, lat_sd_ms : (k,)
        Times and their standard deviations, above 0.

    Returns
    -------
    tuple of (name, probability)
    """
    sd = lat_sd_ms[:, None]
    times = np.linspace((lat_ms - 6 * sd[:, 0]).min(), (lat_ms + 6 * sd[:, 0]).min(), 4001)
    z = (times - lat_ms[:, None]) / sd
    log_later = log_ndtr(-z)
    others = log_later.sum(axis=0) - log_later
    share = np.exp(-0.5 * z**2 - np.log(sd) + others).sum(axis=1)
    share = np.where(share >= LEAST_PROBABILITY * share.sum(), share, 0.0)
    share /= share.sum()
    order = np.argsort(-share, kind="stable")
    return tuple((str(names[index]), float(share[index])) for index in order if share[index] > 0)
