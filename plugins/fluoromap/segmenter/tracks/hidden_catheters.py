"""Catheters that noise hides in every frame: found in moved means, then followed along the run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence, Set
from dataclasses import replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Chain, FrameChains
from fluoromap.segmenter.shape.chain_comparison import chain_distance

_SEARCHED_AT = 0.25, 0.625, 0.875
"""Where in the run catheters are searched: at three moments of different motion."""
_SAME_ELECTRODE_MM, _SAME_CHAIN_PX = 1.2, 4.0

MovingSearch = Callable[[int], Sequence[Chain]]
"""Frame -> chains in the means of frames round it that are moved along velocities, most probable first."""

Follow = Callable[[Sequence[FrameChains], FrameChains], tuple[FrameChains, ...]]
"""(chains of each frame, chains to start from) -> tracked chains of each frame."""


def add_hidden_catheters(
    found: Sequence[FrameChains],
    tracked: tuple[FrameChains, ...],
    catalogue: Catalogue,
    px_per_mm: float,
    search: MovingSearch,
    follow: Follow,
) -> tuple[FrameChains, ...]:
    """Return the tracked chains with those of catheters that lacked a track.

    A longer catheter replaces a track on some of its electrodes, but no track with a mark. Nothing changes where no more electrodes
    are tracked then, of these catheters or of others that another start shows.

    Parameters
    ----------
    found, tracked : sequence of FrameChains
        Chains of each frame before and after tracking.
    catalogue : Catalogue
    px_per_mm : float
        Of the frame, at the isocentre.
    search : MovingSearch
        Called only while a catheter of the catalogue has no track.
    follow : Follow
    """
    listed = Counter(catheter.electrodes for catheter in catalogue.catheters)
    for part in _SEARCHED_AT:
        sizes = {chain.track: len(chain.electrodes) for entry in tracked for chain in entry.chains}
        if not listed - Counter(sizes.values()):
            break
        marked = {chain.track for entry in tracked for chain in entry.chains if chain.manual}
        frame = int(part * len(tracked))
        chains = list(tracked[frame].chains)
        wrong: set[int] = set()
        added: list[Chain] = []
        for chain in sorted(search(frame), key=lambda chain: -len(chain.electrodes)):
            size = len(chain.electrodes)
            shared = [other for other in (*chains, *added) if _share_electrodes(chain, other, px_per_mm)]
            present = sum(of == size for track, of in sizes.items() if track not in wrong)
            present += sum(len(other.electrodes) == size for other in added)
            replaces = all(len(other.electrodes) < size and other.track not in marked for other in shared)
            if present < listed[size] and replaces:
                wrong |= {other.track for other in shared}
                chains = [other for other in chains if other not in shared]
                added.append(chain)
        if added:
            left = [_without(entry, known, wrong) for entry, known in zip(found, tracked, strict=True)]
            again = follow(left, FrameChains(frame, (*chains, *added)))
            # Another start also gives anatomy another chance to pass for a catheter.
            if _electrodes(again) > _electrodes(tracked):
                found, tracked = left, again
    return tracked


def _share_electrodes(one: Chain, other: Chain, px_per_mm: float) -> bool:
    """Return whether two or more electrodes lie on electrodes of another chain."""
    away = np.linalg.norm(one.pixels_uv[:, None] - other.pixels_uv[None], axis=2).min(axis=1)
    return int(np.count_nonzero(away < _SAME_ELECTRODE_MM * px_per_mm)) >= 2


def _without(entry: FrameChains, tracked: FrameChains, wrong: Set[int]) -> FrameChains:
    """Return a frame's chains without those of wrong tracks."""
    places = [chain for chain in tracked.chains if chain.track in wrong]
    kept = (
        chain for chain in entry.chains if all(sum(chain_distance(chain, place)) > _SAME_CHAIN_PX for place in places)
    )
    return replace(entry, chains=tuple(kept))


def _electrodes(entries: Sequence[FrameChains]) -> int:
    return sum(len(chain.electrodes) for entry in entries for chain in entry.chains)
