"""Chains without the electrodes that their image does not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fluoromap.contracts import Chain, FrameChains, Segmentation
from fluoromap.reasons import Reason

DIM_BELOW = 0.2
"""An electrode fainter than this share of its chain's clearest one was only predicted; it is left out."""
LEAST_VISIBLE = 3
"""A chain with fewer visible electrodes may be background, and its tip may be at either end."""


def visible_part(found: Segmentation, dim_below: float = DIM_BELOW) -> Segmentation:
    """Return the segmentation without electrodes that were only predicted; see :data:`DIM_BELOW`."""
    diastole = None if found.diastole is None else _visible_chains(found.diastole, dim_below)
    frames = tuple(_visible_chains(entry, dim_below) for entry in found.frames)
    return replace(found, frames=frames, diastole=diastole)


def _visible_chains(entry: FrameChains, dim_below: float) -> FrameChains:
    """Return the entry without electrodes that the image does not show.

    Where no chain is left, ``manual_needed`` is set.
    """
    chains = tuple(visible for chain in entry.chains if (visible := _visible_part(chain, dim_below)) is not None)
    reason = entry.manual_needed
    if entry.chains and not chains:
        reason = reason or Reason.MANUAL_NEEDED
    return replace(entry, chains=chains, manual_needed=reason)


def _visible_part(chain: Chain, dim_below: float) -> Chain | None:
    if chain.manual:
        return chain
    visible = np.flatnonzero(chain.scores >= dim_below * chain.scores.max())
    if len(visible) == len(chain.electrodes):
        return chain
    if len(visible) < LEAST_VISIBLE:
        return None
    return replace(
        chain,
        electrodes=tuple(chain.electrodes[index] for index in visible),
        pixels_uv=chain.pixels_uv[visible],
        covariance_px2=chain.covariance_px2[visible],
        scores=chain.scores[visible],
    )
