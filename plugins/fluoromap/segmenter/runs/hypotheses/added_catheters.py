"""Catheters of one segmentation of a run, added to those of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Chain, FrameChains, Segmentation
from fluoromap.reasons import Reason
from fluoromap.segmenter.tracks.track import Track
from fluoromap.segmenter.tracks.track_names import surplus

_BESIDE_MM = 1.5
_SHARED = 2
_TINY = 1e-9


def add_catheters(found: Segmentation, other: Segmentation, catalogue: Catalogue, px_per_mm: float) -> Segmentation:
    """Return a segmentation with those catheters of another one that it lacks.

    Tracks of half of the frames are added, those of most electrodes first. No two of their electrodes may lie on a catheter that is
    there in the same frame, and each track must be able to have a catheter of the study for itself.

    Parameters
    ----------
    found, other : Segmentation
        Of the same run.
    catalogue : Catalogue
    px_per_mm : float
        At the isocentre.
    """
    kept = tracks_of(found)
    if not kept:
        return other
    added: dict[int, int] = {}
    for number, track in sorted(tracks_of(other).items(), key=lambda one: -len(one[1].chain.electrodes)):
        is_lasting = 2 * len(track.chains) >= len(found.frames)
        has_room = len(kept) < len(catalogue.catheters) and not surplus([*kept.values(), track])
        if is_lasting and has_room and not any(_lies_on(track, of, _BESIDE_MM * px_per_mm) for of in kept.values()):
            added[number] = 1 + max(kept)
            kept[added[number]] = track
    if not added:
        return found
    frames = tuple(_with_tracks(*entries, added) for entries in zip(found.frames, other.frames, strict=True))
    return replace(found, frames=frames, diastole=_diastole(found, other, added))


def tracks_of(found: Segmentation) -> dict[int, Track]:
    """Return the tracks of a segmentation by their numbers."""
    chains: dict[int, dict[int, Chain]] = {}
    for entry in found.frames:
        for chain in entry.chains:
            chains.setdefault(chain.track, {})[entry.frame] = chain
    return {number: _track(of_frames) for number, of_frames in chains.items()}


def _track(chains: dict[int, Chain]) -> Track:
    longest = max(chains.values(), key=lambda chain: len(chain.electrodes))
    by_hand = any(chain.manual for chain in chains.values())
    return Track(longest, 0.0, np.zeros(2), len(chains), manual=by_hand, chains=chains)


def _lies_on(track: Track, other: Track, reach_px: float) -> bool:
    """Return whether two electrodes of a track lie on another track in a frame."""
    return any(
        np.count_nonzero(_from_line(chain.pixels_uv, other.chains[frame].pixels_uv) <= reach_px) >= _SHARED
        for frame, chain in track.chains.items()
        if frame in other.chains
    )


def _from_line(points_uv: Array, line_uv: Array) -> Array:
    """Return how far points are from a line through others, (n,) pixels."""
    way = np.diff(line_uv, axis=0, append=line_uv[-1:])
    from_start = points_uv[:, None] - line_uv
    along = np.clip((from_start * way).sum(axis=2) / np.maximum((way * way).sum(axis=1), _TINY), 0.0, 1.0)
    nearest: Array = np.linalg.norm(from_start - along[..., None] * way, axis=2).min(axis=1)
    return nearest


def _with_tracks(entry: FrameChains, other: FrameChains, added: dict[int, int]) -> FrameChains:
    """Return a frame's chains with those of added tracks.

    added : number of a track in the other segmentation -> its new number.
    """
    more = _renumbered(other.chains, added)
    chains = *entry.chains, *more
    if not chains:
        return entry
    # One of MANUAL_NEEDED has no chains: then those of its catheters are interrupted here.
    lacking = entry.manual_needed or (other.manual_needed if len(more) < len(added) else None)
    return FrameChains(entry.frame, chains, Reason.TRACK_INTERRUPTED if lacking is Reason.MANUAL_NEEDED else lacking)


def _diastole(found: Segmentation, other: Segmentation, added: dict[int, int]) -> FrameChains | None:
    """Return the diastolic chains with those of added tracks.

    Where the other segmentation has other frames at diastole, the chains of the middle frame are added.
    """
    if found.diastole is None or other.diastole is None:
        return found.diastole
    is_same = other.diastole_frames == found.diastole_frames
    there = other.diastole if is_same else other.frames[found.diastole.frame]
    chains = *found.diastole.chains, *_renumbered(there.chains, added)
    # What one segmentation leaves unexplained may be what the other adds.
    left = found.diastole.manual_needed is other.diastole.manual_needed is Reason.EXTRA_CATHETER
    return FrameChains(found.diastole.frame, chains, Reason.EXTRA_CATHETER if left else None)


def _renumbered(chains: Sequence[Chain], added: dict[int, int]) -> tuple[Chain, ...]:
    return tuple(chain.on_track(added[chain.track]) for chain in chains if chain.track in added)
