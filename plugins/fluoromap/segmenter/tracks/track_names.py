"""Names of tracks: each catheter of the study has one track at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.segmenter.tracks.track import Track

_POSSIBLE = 0.05
_AT_ONE_TIME = 0.5


def surplus(tracks: Sequence[Track]) -> list[Track]:
    """Return the tracks for which the study has no catheter left.

    No single frame shows more catheters of a kind than the study has, but tracks that began in different frames may. Those that
    were found in fewer frames are left over. Tracks that were set by hand keep their names.
    """
    left_over: list[Track] = []
    kept: list[tuple[Track, frozenset[str]]] = []
    for track in sorted(tracks, key=lambda track: (not track.manual, -track.detections, -len(track.chains))):
        own = track, _possible_names(track)
        beside = [other for other in kept if _at_one_time(track, other[0])]
        if track.manual or _have_names([*(names for _, names in beside), own[1]]):
            kept.append(own)
        else:
            left_over.append(track)
    return left_over


def _possible_names(track: Track) -> frozenset[str]:
    chains = track.chains.values()
    names = {name for chain in chains for name, _ in chain.kinds}
    return frozenset(
        name
        for name in names
        if math.fsum(chain.probability(name) for chain in chains) >= _POSSIBLE * len(track.chains)
    )


def _at_one_time(one: Track, other: Track) -> bool:
    """Return whether two tracks share half of the frames of the shorter one."""
    shared = len(one.chains.keys() & other.chains.keys())
    return shared >= _AT_ONE_TIME * min(len(one.chains), len(other.chains))


def _have_names(possible: Sequence[frozenset[str]]) -> bool:
    """Return whether each of some tracks can have a name of its own."""
    names = sorted(frozenset().union(*possible))
    impossible = np.array([[name not in own for name in names] for own in possible], np.float64)
    rows, columns = linear_sum_assignment(impossible)
    return len(rows) == len(possible) and not impossible[rows, columns].any()
