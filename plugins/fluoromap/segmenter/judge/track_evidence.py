"""Whether a run shows a catheter along a track: rules about the network's answers in the means along it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import InitVar, dataclass, field

import numpy as np

from fluoromap.contracts import Array, BoolArray, Chain, IntArray
from fluoromap.segmenter.electrodes.network.weights import Trained
from fluoromap.segmenter.judge.acceptance import UNSEEN
from fluoromap.segmenter.judge.features.bars import follows_bars, has_other_wall
from fluoromap.segmenter.judge.features.dark_lines import DarkLineLimits, ends_on_coil, gap_share, goes_on, is_dark_line
from fluoromap.segmenter.judge.features.track_means import (
    SectionOdds,
    TrackMeans,
    all_along,
    first_and_last,
    in_sections,
)
from fluoromap.segmenter.judge.features.unexplained_rows import EVEN_ODDS, Onwards, onwards
from fluoromap.segmenter.judge.verdict import Verdict
from fluoromap.segmenter.judge.visible_part import LEAST_VISIBLE
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.recall import Recall, compute_always
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

_Said = tuple[float, Array]
"""Log-odds of the middle electrode of a track, and of each one (n,), in some means."""

_OF_SHAFT = 2.3
"""Log-odds of a tip where one end only has a clear shaft, by logistic regression on simulated catheters."""
_OF_TIPS, _MOST_TIPS = 0.5, 4.0
"""Log-odds of a tip for one by which the ends' logits differ, and how much they differ at most.

A third of what their spread over simulated tracks gives: single frames say the same.
"""
_LIKELY = 0.5
_FOLLOWED, _FOLLOWED_FRAMES = 0.8, 6
"""Share of the run's frames, and how many the run has at least: fewer say little."""
_STILL_MM, _MOMENT_MS, _BEAT_MS = 1.2, 300.0, 1000.0
"""A catheter in a beating heart moves farther, but not in so short a time as a moment, and perhaps not in less than a beat."""
_LEAST_LOW = -2.0
"""Log-odds of the worst electrode."""
_DENIED, _DENIED_LONG = -3.0, -4.0
"""Mean log-odds of a place that is clearly no electrode: of short catheters, and of long ones, which clutter hides more often."""
_DARK_LINES = DarkLineLimits(thinnest=0.6, sure=0.5, sure_long=2.0)
"""In the means along a track, which have less noise than a frame."""
_CLEAR_GAPS, _DARK_GAPS = 0.3, 0.5
"""How dark gaps are, as a share of the electrodes' depth, see :func:`~fluoromap.segmenter.judge.features.dark_lines.gap_share`.
Gaps of a loop are not measured: seen on edge, both of its sides are one line."""
_LINE_GAPS, _MOST_OF_SHAFT = 0.8, 1
"""How dark gaps on one line are, as a share of the electrodes' depth, and how many places on it may be improbable. Else two
electrodes of a lead and two places of its shaft look like a catheter, and so does a row between fewer electrodes."""
_MOST_DENIED = 1
"""Places of a long row that may be denied: two are beside the catheter, or on a shorter one."""
_LEAST_BESIDE_HIDDEN = 8
"""Electrodes that a long row shows beside a pair that something hides, as an echo probe does."""
_NOTHING, _BELOW_OTHERS = -1.0, 3.5
"""Log-odds of a place without an electrode in a long row, in both means: below this, and so far below the middle electrode."""
_MOST_BLANK, _FOR_ONE_BLANK, _BLANK_DEPTH = 1, 5, 0.35
"""Places of a track that may show nothing, or one for each five electrodes, and the depth below which they show nothing, as a share
of the darker electrodes' depth. The mean of all frames may blur what lies there until it looks like electrodes."""
_LOW_QUANTILE = 0.1
_LEAST_MEAN, _COUNTED = 0.5, (-4.0, 2.5)
"""Mean log-odds of all electrodes, each within these bounds, that excuses the worst one: the network may miss one of four."""
_TIP, _TIP_OVER_END = 0.4, 1.0
"""Logit of a tip that is sure, and how much more that is than at the other end. The network learned tips from electrodes alone, so
that clutter rarely has one."""
_CLEAR, _CLEAR_WITH_TIP = 1.0, 0.5
"""Log-odds of the middle electrode of a track that needs no more frames; a short one needs no other track beside it either. Clutter
rarely has a long tip."""
_MOST_PROBE_TURN = 2.4
"""Radians. What lies beside a loop, as another wall beside a probe's, is the loop's own other side."""
_ELECTRODE, _CLEARLY_LESS = 1.0, 0.5
"""Log-odds of an electrode beyond an end of a row, and how much less than those of the row's electrodes they may be."""
_MOST_OUTSIDE = 0.5
"""Share of the frames in which an electrode may lie outside the field, where nothing shows, and still count."""


@dataclass(frozen=True, slots=True)
class _ByGaps:
    """A limit for rows of separate dark spots, and for rows of parts on a dark line; between them where gaps are neither.

    The network doubts electrodes in noise, but few other things are rows of spots with clear gaps.
    """

    clear: float
    dark: float

    def at(self, gap_share: float) -> float:
        """Return the limit for gaps this dark."""
        return float(np.interp(gap_share, (_CLEAR_GAPS, _DARK_GAPS), (self.clear, self.dark)))


@dataclass(frozen=True, slots=True)
class _Least:
    """Least log-odds of the middle electrode of a track, on average over the pictures.

    Clutter rarely looks like the same catheter in every frame, and it rarely moves as the heart does.

    track : of any track. followed : of one that was found in nearly all frames. still : of one that does not move.
    waiting : of one that does not move, but was found in nearly all frames of a run shorter than a beat. moment : the same in a run
    so short that nothing need move. hidden, hidden_still : of one that was found in nearly all frames and that noise may hide, as
    it may hide the other catheters; a long row has no such excuse.
    """

    track: float
    followed: _ByGaps
    still: float
    waiting: _ByGaps
    moment: _ByGaps
    hidden: _ByGaps = _ByGaps(math.inf, math.inf)
    hidden_still: float = math.inf


_DISPLACED = _ByGaps(-5.0, -4.0)
"""Mean log-odds of the worst place of a long row below which it may be displaced along its catheter."""
_LEAST_LOW_STILL, _LEAST_LOW_WAITING = -0.7, _ByGaps(-1.5, -0.7)
"""Log-odds of the worst electrode of a track that does not move, and of one that may just not have moved yet."""
_SURE_MIDDLE, _EXCUSED_TIP = 1.5, -1.5
"""Log-odds of the middle electrode of a track that has just not moved yet, and of its worse end: the network doubts long tips."""
_LEAST = _Least(
    0.35,
    _ByGaps(-0.4, 0.35),
    still=1.2,
    waiting=_ByGaps(0.3, 1.2),
    moment=_ByGaps(-0.4, 1.2),
    hidden=_ByGaps(-2.1, 0.45),
    hidden_still=0.6,
)
_LEAST_LONG = _Least(0.0, _ByGaps(-2.6, 0.0), still=0.8, waiting=_ByGaps(0.3, 0.8), moment=_ByGaps(-2.6, 0.8))
"""Of six or more electrodes. Clutter often hides some of them: the worst electrodes do not count."""
_WITH_TIP, _WITH_TIP_ON_LINE = (-0.6, -2.5), (0.0, -1.5)
"""Least log-odds of the middle and the worst electrode of a catheter that moves and has a sure long tip; on a dark line, as which a
long tip and the rings near it may show."""
_LEAST_PAIR = _Least(
    1.2,
    _ByGaps(0.8, 0.8),
    still=1.6,
    waiting=_ByGaps(1.6, 1.6),
    moment=_ByGaps(0.8, 1.6),
    hidden=_ByGaps(0.8, 0.8),
    hidden_still=1.6,
)
"""Of two electrodes, which is little: any two dark spots are a pair."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What the means along a track show.

    frames : those that show most of its electrodes. paths_uv : (frames, electrodes, 2) places in them. inside : (electrodes,)
    whether they lie in the field. middles, pictures : of each mean, the frame in its middle, as an index, and the evidence of its
    sections. odds : (pictures, electrodes inside). depths : of each section, see
    :func:`~fluoromap.segmenter.judge.features.dark_lines.depths_along`. has_long_tip, is_likely_loop : whether it is likely a
    catheter with a long tip, or a circular one. moves : whether it does, in the run.
    """

    frames: Sequence[int]
    paths_uv: Array
    inside: BoolArray
    middles: Sequence[int]
    pictures: Sequence[Sequence[SectionOdds]]
    odds: Array
    depths: Sequence[Array]
    has_long_tip: bool
    is_likely_loop: bool
    moves: bool

    @property
    def electrodes(self) -> int:
        """How many the track has."""
        return int(self.paths_uv.shape[1])

    @property
    def is_row(self) -> bool:
        """Whether the catheter is a long one, which has limits of its own."""
        return self.electrodes >= MANY_ELECTRODES

    @property
    def is_loop(self) -> bool:
        """Whether the catheter turns back to itself."""
        return self.is_row and _turn(self.paths_uv[len(self.frames) // 2]) >= _MOST_PROBE_TURN

    @property
    def on_line(self) -> bool:
        """Whether the electrodes are parts of a dark line."""
        odds = self.odds.mean(axis=0)
        return is_dark_line(self.depths, odds, _DARK_LINES) or ends_on_coil(self.depths, odds)

    @property
    def has_tip(self) -> bool:
        """Whether it is a short catheter that moves and has a sure long tip. Two dark spots are little."""
        is_short = LEAST_VISIBLE <= self.electrodes < MANY_ELECTRODES
        return is_short and self.moves and self.has_long_tip and _has_sure_tip(self.pictures)

    @property
    def gaps(self) -> float:
        """How dark the gaps are, see :func:`~fluoromap.segmenter.judge.features.dark_lines.gap_share`."""
        return 0.5 * (_CLEAR_GAPS + _DARK_GAPS) if self.is_loop else gap_share(self.depths)

    @property
    def is_something_else(self) -> bool:
        """Whether it is a probe, a line, a part of a longer thing, or has places where nothing shows."""
        odds = self.odds.mean(axis=0)
        if not self.is_loop and (_is_probe(self.pictures) or (self.on_line and not self.has_tip)):
            return True
        beyond = np.mean([(sections[0].beyond[0], sections[-1].beyond[1]) for sections in self.pictures], axis=0)
        if not self.is_likely_loop and not _ends_in_tip(self.pictures) and goes_on(self.depths, beyond):
            return True
        if _count_blank(self.depths, odds, self.inside) > max(_MOST_BLANK, self.electrodes // _FOR_ONE_BLANK):
            return True
        return not self.has_tip and self.gaps >= _LINE_GAPS and _count_improbable(odds) > _MOST_OF_SHAFT

    @property
    def tip_odds(self) -> float | None:
        """Log-odds that the track begins at its tip; None where single frames show it, as of a long tip."""
        return None if self.is_loop or self.has_long_tip else _tip_odds(self.pictures)


@dataclass(slots=True, eq=False)
class TrackEvidence:
    """Judge of the tracks of one run.

    frame_times_ms : (frames,) of the run. long_tips : names of the catheters whose tips are longer than rings for certain.
    circular : names of the circular ones.
    """

    trained: InitVar[Trained]
    px_per_mm: float
    frame_times_ms: Array
    long_tips: frozenset[str] = frozenset()
    circular: frozenset[str] = frozenset()
    _means: TrackMeans = field(init=False)

    def __post_init__(self, trained: Trained) -> None:
        self._means = TrackMeans(trained, self.px_per_mm)

    def __call__(
        self,
        chains: Mapping[int, Chain],
        log_image: Callable[[int], Image],
        recall: Recall[SectionOdds] = compute_always,
    ) -> Verdict:
        """Return whether the run shows a catheter where a track's chains (frame -> chain) are."""
        usual, _ = Counter(chain.electrodes for chain in chains.values()).most_common(1)[0]
        frames = [frame for frame, chain in sorted(chains.items()) if chain.electrodes == usual]
        paths_uv = np.array([chains[frame].pixels_uv for frame in frames])
        inside = np.array([chains[frame].scores > UNSEEN for frame in frames]).mean(axis=0) >= 1.0 - _MOST_OUTSIDE
        if np.count_nonzero(inside) < min(LEAST_VISIBLE, len(usual)):
            return Verdict(False)

        def sections_in(picture: IntArray) -> list[SectionOdds]:
            averaged = [frames[index] for index in picture]

            def section_along(path_uv: Array) -> SectionOdds:
                def compute() -> SectionOdds:
                    return self._means.evidence_along(averaged, path_uv, log_image)

                return recall(SectionOdds, (tuple(averaged), path_uv), compute)

            return [section_along(part) for part in in_sections(paths_uv[picture])]

        chosen = first_and_last(len(frames))
        pictures = [sections_in(picture) for picture in chosen]
        seen = _Seen(
            frames,
            paths_uv,
            inside,
            middles=[picture[len(picture) // 2] for picture in chosen],
            pictures=pictures,
            odds=np.array([_odds_of(sections, inside) for sections in pictures]),
            depths=[np.mean([one.depths for one in same], axis=0) for same in zip(*pictures, strict=True)],
            has_long_tip=self._is_likely(chains, self.long_tips),
            is_likely_loop=self._is_likely(chains, self.circular),
            moves=not self._is_at_rest(paths_uv),
        )
        if seen.is_something_else:
            return Verdict(False)
        said: list[_Said] = [(float(np.median(seen.odds, axis=1).mean()), seen.odds.mean(axis=0))]
        if said[0][0] < _CLEAR or not self._is_settled(seen):
            # Twice as many frames have less noise. A run that is too short for two pictures has been judged by all its frames.
            more = _odds_of(sections_in(all_along(len(frames))), inside) if len(pictures) > 1 else seen.odds[0]
            said.append((float(np.median(more)), more))
        return self._verdict_of_row(seen, said) if seen.is_row else self._verdict_of_few(seen, said)

    def _verdict_of_row(self, seen: _Seen, said: Sequence[_Said]) -> Verdict:
        """Return the verdict on a long catheter.

        Clutter may hide some of its electrodes.
        """
        middle = max(of_middle for of_middle, _ in said)
        # A chain that is displaced along its catheter has clear electrodes, and places that are clearly none.
        displaced = seen.odds.mean(axis=0).min() < _DISPLACED.at(seen.gaps)
        least = _LEAST_LONG.track if displaced else self._least(seen.paths_uv, _LEAST_LONG, seen.gaps)
        best = np.max([of_each for _, of_each in said], axis=0)
        # Noise may hide electrodes of a catheter that is not clear itself.
        unseen = np.zeros(seen.electrodes, np.bool_)
        unseen[seen.inside] = (best < _DENIED) & (middle >= _CLEAR)
        return Verdict(
            middle >= least and _are_of_long_catheter(best, middle),
            middle,
            tip_odds=seen.tip_odds,
            hidden=tuple(unseen.tolist()) if unseen.any() else (),
            onwards=self._onwards_of_pictures(seen),
        )

    def _verdict_of_few(self, seen: _Seen, said: Sequence[_Said]) -> Verdict:
        """Return the verdict on a catheter of few electrodes."""
        middle, of_each = max(said, key=lambda one: one[0])
        limits = _LEAST if seen.electrodes >= LEAST_VISIBLE else _LEAST_PAIR
        least = self._least(seen.paths_uv, limits, seen.gaps)
        is_catheter = not seen.on_line and any(
            of_middle >= least and self._are_electrodes(seen, odds) for of_middle, odds in said
        )
        if seen.has_tip and not is_catheter:
            least, least_worst = _WITH_TIP_ON_LINE if seen.on_line else _WITH_TIP
            is_catheter = any(of_middle >= least and odds.min() >= least_worst for of_middle, odds in said)
        worst_still = self._worst_at_rest(seen)
        hidden, worst = (
            (limits.hidden.at(seen.gaps), _DENIED) if worst_still is None else (limits.hidden_still, worst_still)
        )
        may_be_hidden = bool(
            not seen.on_line and self._is_followed_long(seen.paths_uv) and middle >= hidden and of_each.min() >= worst
        )
        is_clear = middle >= (_CLEAR_WITH_TIP if seen.has_tip and not seen.on_line else _CLEAR)
        ends = self._onwards_of_pictures(seen)
        return Verdict(is_catheter, middle, may_be_hidden, seen.tip_odds, onwards=ends, is_clear=is_clear)

    def _is_settled(self, seen: _Seen) -> bool:
        """Return whether the first and the last frames already show electrodes everywhere."""
        odds = seen.odds.mean(axis=0)
        return bool(odds.min() >= _NOTHING) if seen.is_row else self._are_electrodes(seen, odds)

    def _are_electrodes(self, seen: _Seen, odds: Array) -> bool:
        return _are_electrodes(odds, self._worst_at_rest(seen), self._is_waiting(seen.paths_uv))

    def _worst_at_rest(self, seen: _Seen) -> float | None:
        """Return the least log-odds of a resting track's worst electrode.

        None for a track that moves.
        """
        if not self._is_still(seen.paths_uv):
            return None
        return _LEAST_LOW_WAITING.at(seen.gaps) if self._is_waiting(seen.paths_uv) else _LEAST_LOW_STILL

    def _onwards_of_pictures(self, seen: _Seen) -> tuple[tuple[Onwards, Onwards], ...]:
        """Return what lies in the line of a row in each picture.

        A loop has no line.
        """
        if seen.is_loop:
            return ()
        return tuple(
            self._onwards(seen.frames[index], seen.paths_uv[index], sections, _odds_of(sections, seen.inside))
            for index, sections in zip(seen.middles, seen.pictures, strict=True)
        )

    def _onwards(
        self, frame: int, row_uv: Array, sections: Sequence[SectionOdds], odds: Array
    ) -> tuple[Onwards, Onwards]:
        """Return the electrodes in the line of a row in one picture.

        They lie before its first and beyond its last electrode. odds : of the row's own. All look alike, so less probable ones are
        something else.
        """
        least = max(_ELECTRODE, float(odds.min()) - _CLEARLY_LESS)
        as_sure = max(_ELECTRODE, float(np.median(odds)))

        def beyond(row_uv: Array, section: SectionOdds) -> Onwards:
            sure = section.near_odds >= least
            found_odds = section.near_odds[sure]
            return onwards(frame, row_uv, section.near_uv[sure], found_odds >= as_sure, self.px_per_mm)

        return beyond(row_uv[::-1], sections[0]), beyond(row_uv, sections[-1])

    def _is_likely(self, chains: Mapping[int, Chain], names: frozenset[str]) -> bool:
        """Return whether a track is likely one of these catheters."""
        probabilities = [probability for chain in chains.values() for name, probability in chain.kinds if name in names]
        return math.fsum(probabilities) >= _LIKELY * len(chains)

    def _least(self, path_uv: Array, least: _Least, gaps: float) -> float:
        """Return the least log-odds of a track with these places.

        path_uv : (frames, electrodes, 2). gaps : how dark they are, see
        :func:`~fluoromap.segmenter.judge.features.dark_lines.gap_share`.
        """
        if self._is_still(path_uv):
            return least.waiting.at(gaps) if self._is_waiting(path_uv) else least.still
        if not self._is_followed_long(path_uv):
            return least.track
        return (least.moment if self._is_at_rest(path_uv) else least.followed).at(gaps)

    def _is_waiting(self, path_uv: Array) -> bool:
        """Return whether a followed track may just not have moved yet.

        The run is shorter than a beat.
        """
        return bool(np.ptp(self.frame_times_ms) < _BEAT_MS) and self._is_followed_long(path_uv)

    def _is_still(self, path_uv: Array) -> bool:
        """Return whether places (frames, electrodes, 2) hardly move, although the run is long enough."""
        is_moment = self._is_followed(path_uv) and np.ptp(self.frame_times_ms) < _MOMENT_MS
        return self._is_at_rest(path_uv) and not is_moment

    def _is_at_rest(self, path_uv: Array) -> bool:
        """Return whether places (frames, electrodes, 2) hardly move."""
        motion_px = np.ptp(path_uv.mean(axis=1), axis=0).max()
        return bool(motion_px < _STILL_MM * self.px_per_mm)

    def _is_followed(self, path_uv: Array) -> bool:
        """Return whether nearly all frames of the run show a track."""
        return len(path_uv) >= _FOLLOWED * len(self.frame_times_ms)

    def _is_followed_long(self, path_uv: Array) -> bool:
        """Return whether nearly all frames show a track.

        In fewer than six frames it says little.
        """
        return self._is_followed(path_uv) and len(self.frame_times_ms) >= _FOLLOWED_FRAMES


def _odds_of(sections: Sequence[SectionOdds], inside: BoolArray) -> Array:
    """Return the log-odds of the electrodes of a picture that lie in the field."""
    odds: Array = np.concatenate([section.log_odds for section in sections])[inside]
    return odds


def _is_probe(pictures: Sequence[Sequence[SectionOdds]]) -> bool:
    """Return whether pictures of a track show an echo probe.

    Each picture has sections.
    """
    beside = np.sum([np.concatenate([section.beside for section in sections], axis=2) for sections in pictures], axis=0)
    across = np.sum([np.concatenate([section.across for section in sections], axis=2) for sections in pictures], axis=0)
    return follows_bars(beside) or has_other_wall(across)


def _tip_odds(pictures: Sequence[Sequence[SectionOdds]]) -> float:
    """Return the log-odds that a track begins at its tip.

    A shaft shows behind a catheter and not before it. The network knows tips: most are darker and longer than rings.
    """
    behind = np.mean([sections[-1].shafts[1] - sections[0].shafts[0] for sections in pictures])
    first, last = _tips(pictures)
    return _OF_SHAFT * float(behind) + _OF_TIPS * float(np.clip(first - last, -_MOST_TIPS, _MOST_TIPS))


def _has_sure_tip(pictures: Sequence[Sequence[SectionOdds]]) -> bool:
    """Return whether the network calls a track's first electrode a tip.

    The last one must be clearly less of a tip.
    """
    first, last = _tips(pictures)
    return bool(first >= _TIP and first - last >= _TIP_OVER_END)


def _ends_in_tip(pictures: Sequence[Sequence[SectionOdds]]) -> bool:
    """Return whether the network calls one end of a track a tip.

    It must be one rather than not, and the other end clearly less.
    """
    tips = _tips(pictures)
    return bool(tips.max() >= EVEN_ODDS and np.ptp(tips) >= _TIP_OVER_END)


def _tips(pictures: Sequence[Sequence[SectionOdds]]) -> Array:
    """Return the mean logits of a tip at the first and the last electrode, (2,)."""
    tips: Array = np.mean([(sections[0].tips[0], sections[-1].tips[1]) for sections in pictures], axis=0)
    return tips


def _turn(path_uv: Array) -> float:
    """Return how far a path (electrodes, 2) turns along itself, radians."""
    ways = np.diff(path_uv, axis=0) @ np.array([1.0, 1.0j])
    return float(abs(np.angle(ways[1:] * ways[:-1].conj()).sum()))


def _are_electrodes(odds: Array, least_still: float | None, waits: bool) -> bool:
    """Return whether log-odds (n,) are those of electrodes.

    Either all are high enough, or the others are so high that they excuse the worst. A place that is clearly none has no excuse.
    Nothing excuses one below ``least_still`` in a track that does not move, as drops of contrast medium at rest look the same in
    each frame, except one end of a clear catheter that just ``waits``.
    """
    if least_still is not None:
        low = np.flatnonzero(odds < least_still)
        is_doubted_tip = waits and np.median(odds) >= _SURE_MIDDLE and low.tolist() in ([0], [len(odds) - 1])
        return not len(low) or bool(is_doubted_tip and odds.min() >= _EXCUSED_TIP)
    if odds.min() < _DENIED:
        return False
    worst = np.quantile(odds, _LOW_QUANTILE, method="lower")
    return bool(worst >= _LEAST_LOW or np.clip(odds, *_COUNTED).mean() >= _LEAST_MEAN)


def _count_blank(depths: Sequence[Array], odds: Array, inside: BoolArray) -> int:
    """Return at how many places of a track nothing shows.

    They are not dark, and the network denies them. odds : of the places ``inside`` the field.
    """
    depth = np.concatenate([section[::2, 0] for section in depths])[inside]
    dark = np.median(np.sort(depth)[len(depth) // 2 :])
    return int(np.count_nonzero((depth < _BLANK_DEPTH * dark) & (odds < _NOTHING)))


def _count_improbable(odds: Array) -> int:
    """Return how many log-odds (n,) speak against an electrode."""
    return int(np.count_nonzero(odds < EVEN_ODDS))


def _are_of_long_catheter(odds: Array, middle: float) -> bool:
    """Return whether log-odds (n,) are those of a long catheter.

    A shorter one lies beside places without electrodes. Something may hide one pair of a clear catheter. middle : log-odds of its
    middle electrode.
    """
    there = np.count_nonzero(odds >= min(_NOTHING, middle - _BELOW_OTHERS))
    if there < min(len(odds), MANY_ELECTRODES):
        return False
    denied = np.flatnonzero(odds < _DENIED_LONG)
    hides_pair = len(denied) == 2 and np.ptp(denied) == 1 and middle >= _CLEAR and there >= _LEAST_BESIDE_HIDDEN
    return bool(len(denied) <= _MOST_DENIED or hides_pair)
