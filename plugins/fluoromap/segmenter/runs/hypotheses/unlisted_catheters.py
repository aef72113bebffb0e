"""Catheters in the image that a study does not list: sought as the types that laboratories use, so that none gets a listed name.

A study's catalogue alone explains each short catheter by the listed one that is most like it, and has no place for one more: an
unlisted catheter would take the place and the name of the ablation catheter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.catheters import Catalogue, Catheter, catheter_type
from fluoromap.contracts import Chain, FrameChains, Segmentation
from fluoromap.reasons import Reason
from fluoromap.segmenter.runs.hypotheses.added_catheters import tracks_of
from fluoromap.segmenter.runs.hypotheses.other_scales import expected_electrodes
from fluoromap.segmenter.shape.chain_comparison import overlaps
from fluoromap.segmenter.tracks.track import Track

USUAL_TYPES = "quadripolar-2-5-2", "decapolar-2-5-2"

_MORE_IN_FRAME, _MORE_IN_RUN = 2.0, 3.0
"""How many more electrodes a frame has to show with these types: in one frame, and in the mean of a run's frames."""
_IMPOSSIBLE, _POSSIBLE = 1e-3, 0.01
_PREFER_LISTED, _SET_BY_HAND = 0.01, 10.0


@dataclass(frozen=True, slots=True)
class ShowsUnlisted:
    """Whether a run shows a catheter that the study does not list."""

    is_shown: bool


def with_usual_types(catalogue: Catalogue) -> Catalogue:
    """Return a catalogue with one more catheter of each usual type.

    Their names are none of the study's.
    """
    more: list[Catheter] = []
    for type_name in USUAL_TYPES:
        name = f"unlisted {type_name}"
        while name in catalogue.names:
            name = f"unlisted {name}"
        more.append(catheter_type(type_name, name))
    return Catalogue((*catalogue.catheters, *more), catalogue.reference or more[0].name, catalogue.mapping)


def asked_frames(count: int) -> tuple[int, ...]:
    """Return which frames of ``count`` are searched for one more catheter."""
    return tuple(dict.fromkeys((count // 2, count // 4)))


def frame_shows_more(expected: float, found: Segmentation, frame: int) -> bool:
    """Return whether a frame shows more electrodes than were found.

    ``expected`` : with the usual types, the sum of their probabilities.
    """
    return expected >= expected_electrodes([found.frames[frame]]) + _MORE_IN_FRAME


def run_shows_more(more: Segmentation, found: Segmentation, catalogue: Catalogue) -> bool:
    """Return whether a segmentation with the usual types shows one more catheter than another.

    It has to show each listed catheter that the other one shows, or an unlisted one in its place.
    """
    gain = expected_electrodes(more.frames) - expected_electrodes(found.frames)
    return gain >= _MORE_IN_RUN * len(found.frames) and not _loses_listed(more, found, catalogue)


def _loses_listed(more: Segmentation, found: Segmentation, catalogue: Catalogue) -> bool:
    """Return whether a listed catheter of ``found`` is lost in ``more``.

    Neither has a track its name, nor lies one in its place that is unlisted or may have that name.
    """
    frames = len(found.frames)
    listed, others = tracks_of(found), tracks_of(more)
    names = _names_of_tracks(others, catalogue, frames)
    unlisted = [track for number, track in others.items() if names.get(number) not in catalogue.names]
    lost = [
        (listed[number], name)
        for number, name in _names_of_tracks(listed, catalogue, frames).items()
        if name not in names.values()
    ]

    def is_there(track: Track, name: str) -> bool:
        likely = [other for other in others.values() if other.chain.probability(name) >= _POSSIBLE]
        return any(_is_at_place(other, track) for other in (*unlisted, *likely))

    return not all(is_there(track, name) for track, name in lost)


def _is_at_place(track: Track, of: Track) -> bool:
    """Return whether a track lies on electrodes of another one.

    It has to in more than half of the other one's frames.
    """
    together = sum(
        overlaps(chain, [track.chains[frame]]) for frame, chain in of.chains.items() if frame in track.chains
    )
    return 2 * together > len(of.chains)


def listed_alone(found: Segmentation, catalogue: Catalogue) -> Segmentation:
    """Return a segmentation with the usual types without the catheters that the study does not list.

    Each track gets a name of its own, so that together they are most probable. Of two catheters that look alike the clearer one
    gets the listed name, with half of the probability. What was set by hand keeps its name.

    Parameters
    ----------
    found : Segmentation
        With the catalogue of :func:`with_usual_types`.
    catalogue : Catalogue
        Of the study.
    """
    tracks = tracks_of(found)
    names = _names_of_tracks(tracks, catalogue, len(found.frames))
    kept = {number for number, track in tracks.items() if track.manual or names.get(number) in catalogue.names}
    # A usual type that no track shows is no other name for those that are there.
    absent = {name for track in tracks.values() for name, _ in track.chain.kinds} - set(names.values())
    absent -= set(catalogue.names)
    usual = [number for number in kept if len(tracks[number].chains) > len(found.frames) / 2]

    def listed(chains: tuple[Chain, ...]) -> tuple[Chain, ...]:
        return tuple(_with_listed_names(chain, catalogue, absent) for chain in chains if chain.track in kept)

    def listed_in(entry: FrameChains) -> FrameChains:
        chains, reason = listed(entry.chains), entry.manual_needed
        if reason is Reason.TRACK_INTERRUPTED and all(entry.frame in tracks[number].chains for number in usual):
            reason = None
        return FrameChains(entry.frame, chains, reason if chains or reason else Reason.MANUAL_NEEDED)

    diastole = found.diastole
    if diastole is not None and len(kept) < len(tracks):
        chains = listed(diastole.chains)
        reason = Reason.EXTRA_CATHETER if chains else Reason.MANUAL_NEEDED
        diastole = FrameChains(diastole.frame, chains, reason)
    elif diastole is not None:
        diastole = replace(diastole, chains=listed(diastole.chains))
    return replace(found, frames=tuple(map(listed_in, found.frames)), diastole=diastole)


def _names_of_tracks(tracks: Mapping[int, Track], catalogue: Catalogue, frames: int) -> dict[int, str]:
    """Return a name for each track."""
    names = sorted({name for track in tracks.values() for name, _ in track.chain.kinds})
    if not names:
        return {}
    costs = np.array([[_cost(track, name, catalogue, frames) for name in names] for track in tracks.values()])
    rows, columns = linear_sum_assignment(costs)
    return {list(tracks)[row]: names[column] for row, column in zip(rows, columns, strict=True)}


def _cost(track: Track, name: str, catalogue: Catalogue, frames: int) -> float:
    if any(chain.manual and chain.probability(name) > 0.0 for chain in track.chains.values()):
        return -_SET_BY_HAND
    seen = sum(float(chain.scores.mean()) for chain in track.chains.values()) / frames
    likely = float(np.log(max(track.chain.probability(name), _IMPOSSIBLE)))
    return -likely - (_PREFER_LISTED * (1.0 + seen) if name in catalogue.names else 0.0)


def _with_listed_names(chain: Chain, catalogue: Catalogue, absent: set[str]) -> Chain:
    there = 1.0 - sum(probability for name, probability in chain.kinds if name in absent)
    kinds = tuple(
        (name, min(1.0, probability / max(there, _IMPOSSIBLE)))
        for name, probability in chain.kinds
        if name in catalogue.names
    )
    return replace(chain, kinds=kinds)
