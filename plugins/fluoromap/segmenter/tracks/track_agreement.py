"""Agreement of a track's frames: they show one catheter, which has one name and bends slowly."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.shape.chain_comparison import compare_shapes, is_same_shape

_FEWEST_FRAMES, _COMPARED = 3, 60
_JUMP_PX = 2.5
_SUPPORTED_AT_LEAST = 0.8
_REACH_PX = 3.0

ShapeSearch = Callable[[int, Chain, Array, float], Chain | None]
"""(frame, chain in another frame, expected shift, reach in pixels) -> the chain in that frame."""


def with_common_kinds(chains: Mapping[int, Chain], track: int) -> dict[int, Chain]:
    """Return a track's chains with its number and the mean of their kinds.

    They are one catheter, and a single frame may be wrong about its name. Chains that were set by hand keep theirs.
    """
    names = dict.fromkeys(name for chain in chains.values() for name, _ in chain.kinds)
    kinds = tuple(
        (name, math.fsum(chain.probability(name) for chain in chains.values()) / len(chains)) for name in names
    )
    return {
        frame: (chain if chain.manual else replace(chain, kinds=kinds)).on_track(track)
        for frame, chain in chains.items()
    }


def with_common_shape(chains: Mapping[int, Chain], search: ShapeSearch) -> dict[int, Chain]:
    """Return a track's chains after a second search for displaced electrodes.

    Clutter or two electrodes in one blob displace some electrodes of a frame, while the others are where the rest of the run
    shows them. Where more frames agree on other places of those electrodes, the frame is searched again with the shape of
    the nearest such frame. The chain remains where that search does not find the shape. A catheter that came to its other shape
    without a jump from one frame to the next is not searched: it has bent.

    Parameters
    ----------
    chains : Mapping of int to Chain
        Frame to chain.
    search : ShapeSearch
        Called for those frames.
    """
    if len(chains) < _FEWEST_FRAMES:
        return dict(chains)
    frames = np.array(sorted(chains))
    places = _places([chains[frame] for frame in frames.tolist()])
    others = np.arange(len(frames))[:: max(1, len(frames) // _COMPARED)]
    same, displaced = compare_shapes(places, places[others])
    support = same.sum(axis=1)
    smooth = _smooth_parts(places)
    displaced &= smooth[:, None] != smooth[others]
    agreed = dict(chains)
    for row in np.flatnonzero((displaced & (support[others] > support[:, None])).any(axis=1)):
        frame = int(frames[row])
        if chains[frame].manual:
            continue
        better = others[displaced[row] & (support[others] > support[row])]
        better = better[support[better] >= _SUPPORTED_AT_LEAST * support[better].max()]
        usual = int(better[np.argmin(np.abs(frames[better] - frame))])
        shape = chains[int(frames[usual])]
        found = search(frame, shape, _median_shift(places[row] - places[usual]), _REACH_PX)
        if found is None or found.electrodes != shape.electrodes:
            continue
        if is_same_shape(found.pixels_uv, shape.pixels_uv):
            agreed[frame] = replace(found, kinds=chains[frame].kinds, tip_odds=chains[frame].tip_odds)
    return agreed


def _smooth_parts(places: Array) -> NDArray[np.int64]:
    """Return numbers (chains,) that are the same for successive chains without a jump between them.

    ``places`` : (chains, electrodes, 2) in the order of time, NaN where a chain lacks an electrode.
    """
    steps = np.diff(places, axis=0)
    jumps = np.asarray(~np.isfinite(steps[..., 0]).any(axis=1))
    rest = steps[~jumps] - np.nanmedian(steps[~jumps], axis=1, keepdims=True)
    jumps[~jumps] = np.nanmax(np.linalg.norm(rest, axis=2), axis=1) >= _JUMP_PX
    return np.concatenate([[0], np.cumsum(jumps)])


def with_shape_of_track(
    chain: Chain, frame: int, track: Mapping[int, Chain], search: Callable[[Chain, Array, float], Chain | None]
) -> Chain:
    """Return the chain of a mean in the shape of its track.

    It is searched again as in :func:`with_common_shape`.

    Parameters
    ----------
    chain : Chain
        In the mean of frames round ``frame``.
    frame : int
    track : Mapping of int to Chain
        Frame to chain of the same catheter.
    search : callable
        (chain in another frame, expected shift, reach in pixels) -> the chain in the mean.
    """

    def search_mean(searched: int, shape: Chain, shift: Array, reach_px: float) -> Chain | None:
        return search(shape, shift, reach_px) if searched == frame else None

    return with_common_shape({**track, frame: chain}, search_mean)[frame]


def _median_shift(difference: Array) -> Array:
    """Return the median (2,) of the differences (electrodes, 2) that both chains have."""
    shift: Array = np.median(difference[np.isfinite(difference[:, 0])], axis=0)
    return shift


def _places(chains: Sequence[Chain]) -> Array:
    """Return the places of all electrodes, (chains, electrodes, 2), NaN where a chain lacks one."""
    numbers = sorted({number for chain in chains for number in chain.electrodes})
    places = np.full((len(chains), len(numbers), 2), np.nan)
    for row, chain in enumerate(chains):
        places[row, [numbers.index(number) for number in chain.electrodes]] = chain.pixels_uv
    return places
