"""Tracks: one catheter's chains along a run, and how chains of different frames compare."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.shape.chain_comparison import overlaps
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES
from fluoromap.segmenter.unlisted import Onwards

KEPT_VELOCITY = 0.6
"""Share of a track's last velocity that is expected to last."""

_SPEED_PX_PER_MS = 13.0 / 16.7
_FARTHEST_PX = 45.0
_NEAREST_PX = 13.0
_LESS_CLEAR, _CLEAR_ROW = 2.0, 0.6
"""How much less clear than the run's other catheters a catheter may be, and what is clear in a long row in itself, log-odds."""


class ChainSearch(Protocol):
    """Search for a chain of another frame."""

    def __call__(
        self,
        frame: int,
        chain: Chain,
        shift: Array,
        reach_px: float,
        taken: Sequence[Chain],
        same_shape: bool = False,
        confirmed: bool = False,
    ) -> Chain | None:
        """Return the chain in a frame; see :meth:`~fluoromap.segmenter.run_segmentation.Detector.find_again`."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a judge says of a track.

    is_catheter : whether the run shows a catheter there. log_odds : of the middle electrode. may_be_hidden : whether it is a
    catheter if noise hides the run's other catheters nearly as much. tip_odds : log-odds by the shaft that the track's first
    electrode is the tip; None where single frames know better. hidden : for each of the track's places whether the run clearly
    shows no electrode there; empty where none is hidden. is_clear : whether it is one although the run shows no clear catheter
    beside it.
    """

    is_catheter: bool
    log_odds: float = 0.0
    may_be_hidden: bool = False
    tip_odds: float | None = None
    hidden: tuple[bool, ...] = ()
    onwards: tuple[tuple[Onwards, ...], ...] = ()
    is_clear: bool = True


TrackJudge = Callable[[Mapping[int, Chain]], Verdict]
"""frame -> chain of one track -> whether the run shows a catheter there."""


@dataclass(slots=True, eq=False)
class Track:
    """A catheter along the run.

    chain, time_ms : the chain that was assigned last, and its time. velocity : (2,) pixels a millisecond, forwards in time.
    detections : number of frames in which the segmenter found it. direction : sum of their log-odds that the tip is the
    track's first electrode. from_seed : whether the seed contains it. verdict : what the judge said of it last.
    """

    chain: Chain
    time_ms: float
    velocity: Array
    detections: int = 1
    direction: float = 0.0
    from_seed: bool = False
    confirmed: bool = False
    manual: bool = False
    chains: dict[int, Chain] = field(default_factory=dict)
    verdict: Verdict | None = None


def meet(track: Track, other: Track) -> bool:
    """Return whether two tracks share electrodes in a frame."""
    return any(overlaps(chain, [other.chains[frame]]) for frame, chain in track.chains.items() if frame in other.chains)


def farthest_px(elapsed_ms: float) -> float:
    """Return how far from its expected place a catheter may be after a time."""
    return min(max(_NEAREST_PX, _SPEED_PX_PER_MS * elapsed_ms), _FARTHEST_PX)


def is_believed(track: Track, tracks: Sequence[Track]) -> bool:
    """Return whether a judged track is a catheter beside the run's other tracks.

    Noise hides all catheters. Where two others are clear, a long row that is not is none: of so many places, some of other things
    look like electrodes. A short catheter may be unclear where it points to the X-ray source. Part of a catheter that the catalogue
    does not list is none of the catalogue.
    """
    verdict = track.verdict
    if verdict is None or _is_part_of_longer(track, tracks):
        return False
    others = [other.verdict for other in tracks if other is not track and other.verdict is not None]
    clear = [other.log_odds for other in others if other.is_catheter]
    if not clear:
        return verdict.is_catheter
    as_clear = verdict.log_odds >= float(np.median(clear)) - _LESS_CLEAR
    is_row = len(track.chain.electrodes) >= MANY_ELECTRODES and len(clear) > 1
    is_clear = as_clear or not is_row or verdict.log_odds >= _CLEAR_ROW
    return (verdict.is_catheter and is_clear) or (verdict.may_be_hidden and as_clear)


def needs_no_other(track: Track) -> bool:
    """Return whether a believed track needs no other one beside it."""
    return track.manual or (track.verdict is not None and track.verdict.is_catheter and track.verdict.is_clear)


def _is_part_of_longer(track: Track, tracks: Sequence[Track]) -> bool:
    """Return whether a track is part of a longer catheter.

    All its pictures show that the electrodes go on, and no other track explains it.
    """
    others = [
        other for other in tracks if other is not track and other.verdict is not None and other.verdict.is_catheter
    ]
    pictures = () if track.verdict is None else track.verdict.onwards
    return bool(pictures) and all(
        any(
            end.unexplained_by([other.chains[end.frame] for other in others if end.frame in other.chains])
            for end in ends
        )
        for ends in pictures
    )
