"""Kinds of gantry, and the errors of a mixture of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc

from fluoromap.contracts import CHI2_95_3D, Array


@dataclass(frozen=True, slots=True)
class GantryKind:
    """A kind of gantry: its errors as multiples of the stated standard deviations, and its share of all gantries."""

    angle: float
    offset: float
    share: float

    @property
    def multiples(self) -> Array:
        """Multiples (14,) of the unknowns' standard deviations.

        See :func:`~fluoromap.triangulator.error_sources.gantry_effect_px`.
        """
        # The measured C-arm had good angles, but errors of the scale to 0.8 %: the scale follows the angles less.
        scale = float(np.sqrt(self.angle))
        return np.array([*([self.angle] * 3 + [self.offset] * 3) * 2, scale, scale])


GANTRY_KINDS = tuple(
    GantryKind(angle, offset, share * given)
    for angle, share, by_offset in (
        (0.5, 0.65, (0.50, 0.36, 0.14)),
        (1.0, 0.22, (0.50, 0.36, 0.14)),
        (2.0, 0.10, (0.20, 0.50, 0.30)),
        (4.0, 0.03, (0.05, 0.25, 0.70)),
    )
    for offset, given in zip((1.0, 2.0, 4.0), by_offset, strict=True)
)
"""Kinds of gantry. A real C-arm had 0.2 to 0.33 degree and 0.5 to 0.8 mm, with tails to 0.8 degree and 2.2 mm: it is of the first
kind, about half of the stated angle. Others have angles as stated, or 2 or 4 times as large. Offsets exceed their stated value
more often than angles do; a C-arm with wrong angles tends to have wrong offsets too."""
LARGEST_MULTIPLE = 4.0
OFFSET_UNKNOWNS = np.array([3, 4, 5, 9, 10, 11])
"""The gantry's unknowns that are offsets, see :func:`~fluoromap.triangulator.error_sources.gantry_effect_px`."""


def second_moment(shares: Array, moments: Array) -> Array:
    """Return the second moment (14, 14) of a mixture of gantries."""
    moment: Array = np.einsum("k,kij->ij", shares, moments)
    return moment


def credible_covariance(shares: Array, moments: Array) -> Array:
    """Return the covariance (14, 14) of a mixture of gantries, with honest tails.

    A mixture has heavier tails than the normal distribution with its second moment: the 95 % ellipsoid of that holds the
    offset of only 90 % of ``GANTRY_KINDS``. The offsets are therefore widened until the ellipsoid holds 95 %. Angles keep
    their second moment: the electrodes of a study show how wrong its angles are.

    Parameters
    ----------
    shares : ndarray, shape (k,)
        Share of each kind of gantry. The sum is 1.
    moments : ndarray, shape (k, 14, 14)
        Second moment of each kind's errors about the mean of the mixture.
    """
    whole = second_moment(shares, moments)
    usual = whole[OFFSET_UNKNOWNS, OFFSET_UNKNOWNS]
    widened = np.ones(len(whole))
    if (usual > 0).all():
        sizes = (moments[:, OFFSET_UNKNOWNS, OFFSET_UNKNOWNS] / usual).mean(axis=1)
        widened[OFFSET_UNKNOWNS] = np.sqrt(max(_credible_size(shares, sizes), 1.0))
    covariance: Array = widened[:, None] * whole * widened
    return covariance


def _credible_size(shares: Array, sizes: Array) -> float:
    """Return the variance of a mixture's 95 % sphere.

    The mixture consists of spherical normal distributions with variances ``sizes`` (k,).
    """
    present = (shares > 0) & (sizes > 0)
    shares, sizes = shares[present], sizes[present]
    if sizes.max() - sizes.min() < 1e-9:
        return float(sizes.max())
    left = partial(_outside, shares, sizes)
    return float(brentq(left, sizes.min(), sizes.max()))


def _outside(shares: Array, sizes: Array, size: float) -> float:
    """Return a mixture's share beyond a 95 % sphere, less 5 %.

    The sphere is that of the variance ``size``.
    """
    return float(shares @ chdtrc(3, CHI2_95_3D * size / sizes)) - 0.05
