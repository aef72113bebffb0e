"""Verdicts on tracks, and whether a judged track is a catheter beside the run's other tracks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fluoromap.contracts import Chain
from fluoromap.segmenter.judge.features.unexplained_rows import Onwards
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

_LESS_CLEAR = 2.0
"""How far a catheter's log-odds may lie below the median of the run's other catheters."""
_CLEAR_ROW = 0.6
"""Log-odds from which on a long row is clear, whatever the others are."""


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


class JudgedTrack(Protocol):
    """What the judge of a run needs of a track.

    manual : whether a user set one of its chains. chain : the chain that was assigned last. chains : frame -> chain. verdict : what
    the judge said of it last.
    """

    @property
    def manual(self) -> bool: ...

    @property
    def chain(self) -> Chain: ...

    @property
    def chains(self) -> Mapping[int, Chain]: ...

    @property
    def verdict(self) -> Verdict | None: ...


def is_believed(track: JudgedTrack, tracks: Sequence[JudgedTrack]) -> bool:
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


def needs_no_other(track: JudgedTrack) -> bool:
    """Return whether a believed track needs no other one beside it."""
    return track.manual or (track.verdict is not None and track.verdict.is_catheter and track.verdict.is_clear)


def _is_part_of_longer(track: JudgedTrack, tracks: Sequence[JudgedTrack]) -> bool:
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
