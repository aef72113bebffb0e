"""Ellipses of electrodes at the scale of their picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fluoromap.contracts import Chain

_FITTED_PX_PER_MM, _OF_SCALE = 5.75, 0.15
"""The scale at which the ellipses fit, and the power of the scale with which they grow more than those of the search do."""


def at_scale(chains: Sequence[Chain], px_per_mm: float) -> tuple[Chain, ...]:
    """Return a picture's chains with the ellipses that their errors have at this scale.

    The search counts electrodes of few pixels as less sure than they are: it weighs their places against the shape of their chain,
    and loses less where it trusts the shape. Chains that were set by hand keep their ellipses.

    Parameters
    ----------
    chains : sequence of Chain
    px_per_mm : float
        At the isocentre.
    """
    factor = (px_per_mm / _FITTED_PX_PER_MM) ** (2.0 * _OF_SCALE)
    return tuple(
        chain if chain.manual else replace(chain, covariance_px2=factor * chain.covariance_px2) for chain in chains
    )
