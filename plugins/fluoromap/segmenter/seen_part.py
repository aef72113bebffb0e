"""Chains without the electrodes that their image does not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fluoromap.contracts import Chain, FrameChains, Segmentation
from fluoromap.reasons import Reason

DIM_BELOW = 0.2
"""An electrode that is fainter than this share of its chain's clearest was predicted, not seen: it is not told."""
LEAST_SEEN = 3
"""A catheter of which fewer electrodes are seen cannot be told from background, nor which end is its tip."""


def as_seen(found: Segmentation) -> Segmentation:
    """Return the segmentation without electrodes that were predicted only; see :data:`DIM_BELOW`."""
    diastole = None if found.diastole is None else _as_seen(found.diastole)
    return replace(found, frames=tuple(map(_as_seen, found.frames)), diastole=diastole)


def _as_seen(entry: FrameChains) -> FrameChains:
    """The chains without electrodes that the image does not show; where none is left, that is said."""
    chains = tuple(seen for chain in entry.chains if (seen := _seen_part(chain)) is not None)
    reason = entry.manual_needed
    if entry.chains and not chains:
        reason = reason or Reason.MANUAL_NEEDED
    return replace(entry, chains=chains, manual_needed=reason)


def _seen_part(chain: Chain) -> Chain | None:
    if chain.manual:
        return chain
    seen = np.flatnonzero(chain.scores >= DIM_BELOW * chain.scores.max())
    if len(seen) == len(chain.electrodes):
        return chain
    if len(seen) < LEAST_SEEN:
        return None
    return replace(
        chain,
        electrodes=tuple(chain.electrodes[index] for index in seen),
        pixels_uv=chain.pixels_uv[seen],
        covariance_px2=chain.covariance_px2[seen],
        scores=chain.scores[seen],
    )
