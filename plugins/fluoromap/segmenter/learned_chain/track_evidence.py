"""Whether a run shows a catheter along a track: the network judges pictures that are averaged along it.

Quantum noise makes the network doubt a catheter in single frames. The average of frames that are moved onto each other has little
noise: a catheter becomes clear in it, while beads of contrast medium stay as improbable as they are.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fluoromap.contracts import Array, BoolArray, Chain, IntArray
from fluoromap.segmenter.acceptance import UNSEEN
from fluoromap.segmenter.bars import ACROSS_MM, BESIDE_MM, follows_bars, has_other_wall, products_beside
from fluoromap.segmenter.chain_search import MANY_ELECTRODES
from fluoromap.segmenter.dark_lines import (
    DarkLineLimits,
    depths_along,
    depths_beyond,
    ends_on_coil,
    gap_share,
    goes_on,
    is_dark_line,
)
from fluoromap.segmenter.gaussian_blur import gaussian
from fluoromap.segmenter.learned_chain.network_response import NetworkResponse, network_scale
from fluoromap.segmenter.learned_chain.resampling import add_moved, resampled
from fluoromap.segmenter.learned_chain.weights import Trained
from fluoromap.segmenter.linking import ShaftImage
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.proposals import log_odds
from fluoromap.segmenter.run_segmentation import Recall, compute_always
from fluoromap.segmenter.shaft_ends import shafts_at_ends
from fluoromap.segmenter.tracks import Verdict
from fluoromap.segmenter.unlisted import EVEN_ODDS, Onwards, onwards
from fluoromap.segmenter.visible_part import LEAST_VISIBLE

_AVERAGED = 8
_ORIENTATIONS = 2
_SCALES = 1.0, 0.87
"""Over that of the network. What it says at one scale and denies at the other is luck."""
_PICTURES = 2
_MARGIN_PX = 40.0
_SECTION = 5
_KEPT_FRAMES = _PICTURES * _AVERAGED
_SMOOTH_PX = 1.0
_SHAFT, _OF_SHAFT = 0.03, 2.3
"""Depth of a clear shaft, log units, and the log-odds of a tip where one end only has such a shaft.

By logistic regression on simulated catheters.
"""
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
"""How dark gaps are, as a share of the electrodes' depth, see :func:`~fluoromap.segmenter.dark_lines.gap_share`. Gaps of a loop are
not measured: seen on edge, both of its sides are one line."""
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


@dataclass(frozen=True, eq=False)
class SectionOdds:
    """The evidence for a part of a track, in the mean of some frames.

    log_odds : (n,) of its electrodes. beside, across : see :func:`~fluoromap.segmenter.bars.products_beside`, for its two sets of
    distances. depths : see :func:`~fluoromap.segmenter.dark_lines.depths_along`. shafts : see
    :func:`~fluoromap.segmenter.shaft_ends.shafts_at_ends`. beyond : see
    :func:`~fluoromap.segmenter.dark_lines.depths_beyond`. tips : (2,) the network's logits of a tip at the first and the last
    electrode. near_uv, near_odds : (m, 2) places and (m,) log-odds of all electrodes of the picture, in the frame of its places.
    """

    log_odds: Array
    beside: Array
    across: Array
    depths: Array
    shafts: Array
    beyond: Array
    tips: Array
    near_uv: Array
    near_odds: Array


@dataclass(slots=True, eq=False)
class TrackEvidence:
    """Judge of the tracks of one run.

    frame_times_ms : (frames,) of the run. long_tips : names of the catheters whose tips are longer than rings for certain.
    circular : names of the circular ones.
    """

    trained: Trained
    px_per_mm: float
    frame_times_ms: Array
    long_tips: frozenset[str] = frozenset()
    circular: frozenset[str] = frozenset()
    _reduced: OrderedDict[int, Image] = field(default_factory=OrderedDict, init=False)

    def __call__(
        self,
        chains: Mapping[int, Chain],
        log_image: Callable[[int], Image],
        recall: Recall[SectionOdds] = compute_always,
    ) -> Verdict:
        """Return whether the run shows a catheter where a track's chains (frame -> chain) are."""
        usual, _ = Counter(chain.electrodes for chain in chains.values()).most_common(1)[0]
        frames = [frame for frame, chain in sorted(chains.items()) if chain.electrodes == usual]
        paths = np.array([chains[frame].pixels_uv for frame in frames])
        inside = np.array([chains[frame].scores > UNSEEN for frame in frames]).mean(axis=0) >= 1.0 - _MOST_OUTSIDE
        if np.count_nonzero(inside) < min(LEAST_VISIBLE, len(usual)):
            return Verdict(False)

        def sections_in(picture: IntArray) -> list[SectionOdds]:
            averaged = [frames[index] for index in picture]

            def section_along(path_uv: Array) -> SectionOdds:
                def compute() -> SectionOdds:
                    return self.evidence_along(averaged, path_uv, log_image)

                return recall(SectionOdds, (tuple(averaged), path_uv), compute)

            return [section_along(part) for part in _sections(paths[picture])]

        def odds_of(sections: Sequence[SectionOdds]) -> Array:
            odds: Array = np.concatenate([section.log_odds for section in sections])[inside]
            return odds

        chosen = _first_and_last(len(frames))
        pictures = [sections_in(picture) for picture in chosen]
        is_row = len(usual) >= MANY_ELECTRODES
        is_loop = is_row and _turn(paths[len(paths) // 2]) >= _MOST_PROBE_TURN
        odds = np.array([odds_of(sections) for sections in pictures])
        depths = [np.mean([one.depths for one in same], axis=0) for same in zip(*pictures, strict=True)]
        on_line = is_dark_line(depths, odds.mean(axis=0), _DARK_LINES) or ends_on_coil(depths, odds.mean(axis=0))
        # Two dark spots are little, and a row has limits of its own.
        is_short = LEAST_VISIBLE <= len(usual) < MANY_ELECTRODES
        moves = is_short and not self._is_at_rest(paths)
        has_tip = moves and self._is_likely(chains, self.long_tips) and _has_sure_tip(pictures)
        if not is_loop and (_is_probe(pictures) or (on_line and not has_tip)):
            return Verdict(False)
        beyond = np.mean([(sections[0].beyond[0], sections[-1].beyond[1]) for sections in pictures], axis=0)
        if not self._is_likely(chains, self.circular) and not _ends_in_tip(pictures) and goes_on(depths, beyond):
            return Verdict(False)
        if _count_blank(depths, odds.mean(axis=0), inside) > max(_MOST_BLANK, len(usual) // _FOR_ONE_BLANK):
            return Verdict(False)
        gaps = 0.5 * (_CLEAR_GAPS + _DARK_GAPS) if is_loop else gap_share(depths)
        if not has_tip and gaps >= _LINE_GAPS and _count_improbable(odds.mean(axis=0)) > _MOST_OF_SHAFT:
            return Verdict(False)
        # Of a long tip single frames show which end it is.
        tip_odds = None if is_loop or self._is_likely(chains, self.long_tips) else _tip_odds(pictures)
        still = self._is_still(paths)
        waits = still and self._is_waiting(paths)
        worst_still = None
        if still:
            worst_still = _LEAST_LOW_WAITING.at(gaps) if waits else _LEAST_LOW_STILL
        said = [(float(np.median(odds, axis=1).mean()), odds.mean(axis=0))]
        settled = said[0][1].min() >= _NOTHING if is_row else _are_electrodes(said[0][1], worst_still, waits)
        if said[0][0] < _CLEAR or not settled:
            # Twice as many frames have less noise. A run that is too short for two pictures has been judged by all its frames.
            all_along = odds_of(sections_in(_all_along(len(frames)))) if len(pictures) > 1 else odds[0]
            said.append((float(np.median(all_along)), all_along))
        middle, of_each = max(said, key=lambda one: one[0])
        ends: tuple[tuple[Onwards, Onwards], ...] = ()
        if not is_loop:
            middles = [picture[len(picture) // 2] for picture in chosen]
            ends = tuple(
                self._onwards(frames[index], paths[index], sections, odds_of(sections))
                for index, sections in zip(middles, pictures, strict=True)
            )
        if is_row:
            # A chain that is displaced along its catheter has clear electrodes, and places that are clearly none.
            displaced = odds.mean(axis=0).min() < _DISPLACED.at(gaps)
            least = _LEAST_LONG.track if displaced else self._least(paths, _LEAST_LONG, gaps)
            best = np.max([of_each for _, of_each in said], axis=0)
            # Noise may hide electrodes of a catheter that is not clear itself.
            unseen = np.zeros(len(usual), np.bool_)
            unseen[inside] = (best < _DENIED) & (middle >= _CLEAR)
            return Verdict(
                middle >= least and _are_of_long_catheter(best, middle),
                middle,
                tip_odds=tip_odds,
                hidden=tuple(unseen.tolist()) if unseen.any() else (),
                onwards=ends,
            )
        limits = _LEAST if len(usual) >= LEAST_VISIBLE else _LEAST_PAIR
        least = self._least(paths, limits, gaps)
        is_catheter = not on_line and any(
            middle >= least and _are_electrodes(of_each, worst_still, waits) for middle, of_each in said
        )
        if has_tip and not is_catheter:
            least, least_worst = _WITH_TIP_ON_LINE if on_line else _WITH_TIP
            is_catheter = any(middle >= least and of_each.min() >= least_worst for middle, of_each in said)
        hidden, worst = (limits.hidden.at(gaps), _DENIED) if worst_still is None else (limits.hidden_still, worst_still)
        may_be_hidden = bool(
            not on_line and self._is_followed_long(paths) and middle >= hidden and of_each.min() >= worst
        )
        is_clear = middle >= (_CLEAR_WITH_TIP if has_tip and not on_line else _CLEAR)
        return Verdict(is_catheter, middle, may_be_hidden, tip_odds, onwards=ends, is_clear=is_clear)

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

        path_uv : (frames, electrodes, 2). gaps : how dark they are, see :func:`~fluoromap.segmenter.dark_lines.gap_share`.
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

    def evidence_along(self, frames: Sequence[int], path_uv: Array, log_image: Callable[[int], Image]) -> SectionOdds:
        """Return the evidence for electrodes in the mean of these frames.

        The frames are moved along ``path_uv`` (frames, electrodes, 2).
        """
        scale = network_scale(self.px_per_mm)
        middle = path_uv[len(frames) // 2]
        first = np.floor(middle.min(axis=0) - _MARGIN_PX / scale)
        columns, rows = np.ceil((middle.max(axis=0) - first) * scale + _MARGIN_PX).astype(np.int64)
        total = np.zeros((rows, columns), np.float32)
        for frame, points in zip(frames, path_uv, strict=True):
            turn, shift = _similarity(middle, points)
            offset = (turn @ first + shift + 0.5) * scale - 0.5
            small = self._small(frame, log_image, scale)
            add_moved(small, turn, offset, total)
        total /= len(frames)
        answers = [
            NetworkResponse.of_reduced(resampled(total, less), self.trained, scale * less, _ORIENTATIONS)
            for less in _SCALES
        ]
        odds = np.mean([log_odds(seen.shares_at(middle - first)) for seen in answers], axis=0)
        shafts = ShaftImage(gaussian(total, _SMOOTH_PX), 1, _SHAFT, self.px_per_mm * scale)
        chain_uv = (middle - first + 0.5) * scale - 0.5
        beside, across = (products_beside(chain_uv, shafts, distances) for distances in (BESIDE_MM, ACROSS_MM))
        ends = shafts_at_ends(chain_uv, shafts)
        beyond = depths_beyond(chain_uv, shafts)
        tips = np.mean([seen.tip_logits_at((middle - first)[[0, -1]]) for seen in answers], axis=0)
        near_uv = answers[0].found.points_uv
        near_odds = np.mean([log_odds(seen.probability_at(near_uv)) for seen in answers], axis=0)
        sure = near_odds >= EVEN_ODDS
        return SectionOdds(
            odds,
            beside,
            across,
            depths_along(chain_uv, shafts),
            ends,
            beyond,
            tips,
            near_uv[sure] + first,
            near_odds[sure],
        )

    def _small(self, frame: int, log_image: Callable[[int], Image], scale: float) -> Image:
        """Return a frame at the network's scale; the latest are kept for the other tracks."""
        small = self._reduced.get(frame)
        if small is None:
            small = self._reduced[frame] = resampled(log_image(frame), scale)
            if len(self._reduced) > _KEPT_FRAMES:
                self._reduced.popitem(last=False)
        return small


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


def _first_and_last(frames: int) -> list[IntArray]:
    """Return the first and the last eight of a track's frames."""
    size = min(_AVERAGED, frames)
    count = min(_PICTURES, -(-frames // size))
    return [start + np.arange(size) for start in np.linspace(0, frames - size, count).astype(np.int64).tolist()]


def _all_along(frames: int) -> IntArray:
    """Return sixteen frames of a track, evenly over it.

    Motion between them blurs the anatomy, which hides a catheter at rest.
    """
    return np.linspace(0, frames - 1, min(frames, _PICTURES * _AVERAGED)).astype(np.int64)


def _sections(path_uv: Array) -> list[Array]:
    """Split a path into sections of about five electrodes.

    A path has the shape (frames, electrodes, 2). Long catheters bend as they move.
    """
    return np.array_split(path_uv, -(-path_uv.shape[1] // _SECTION), axis=1)


def _similarity(points: Array, moved: Array) -> tuple[Array, Array]:
    """Return the matrix and the shift that move points best.

    The matrix (2, 2) turns and scales. Both sets of points have the shape (n, 2).
    """
    middle, to = points.mean(axis=0), moved.mean(axis=0)
    flat, other = ((side @ np.array([1.0, 1.0j])) for side in (points - middle, moved - to))
    factor = np.vdot(flat, other) / max(float(np.vdot(flat, flat).real), 1e-9)
    turn = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    return turn, to - turn @ middle
