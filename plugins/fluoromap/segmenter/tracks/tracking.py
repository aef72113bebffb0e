"""Tracks of catheters: chains of one catheter in successive frames get the same number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.judge.acceptance import UNSEEN
from fluoromap.segmenter.judge.verdict import TrackJudge, is_believed, needs_no_other
from fluoromap.segmenter.shape.chain_comparison import (
    SAME_PLACE_PX,
    chain_distance,
    count_shared,
    kind_overlap,
    mean_shift,
    overlaps,
    reverse,
)
from fluoromap.segmenter.tracks.track import KEPT_VELOCITY, ChainSearch, Track, farthest_px, meet
from fluoromap.segmenter.tracks.track_agreement import ShapeSearch, with_common_kinds, with_common_shape
from fluoromap.segmenter.tracks.track_completion import completed
from fluoromap.segmenter.tracks.track_names import surplus

_BEND_PX, _BEND_PX_PER_MS, _MOST_BEND_PX = 8.0, 0.15, 14.0
"""How far an electrode may move against its chain between two frames: at least, in time, and at most."""
_STIFF_PX = 3.5
_BENDING_PX_PER_MS = 0.05
_STALE_MS = 50.0
_FAINT = 0.12
"""Share of its best score at an older place below which a chain far from there is something else."""
_OTHER_KIND = 6.0
_IMPOSSIBLE = 1e6
_CONFIRMED_PX = 18.0
_CONFIRMERS = 60
_SEEN_AT_LEAST = 0.2
_RECOVERED_AT_LEAST = 0.5
_LONG_RUN = 5
_REVERSED_PX = 4.0
_TURNED_REACH_PX = 4.0
_MOST_RETRIES, _JUDGED_FRAMES = 2, 4
_ACCEPTED_AT_LEAST = 0.5
_AS_CLEAR = 0.8
"""Share of the median score of a frame's own chain below which a searched one is less clear."""
_LEAST_AGAINST, _CONFIRMED_AGAINST = 2, 0.25
"""Frames that outvote a track, and the share of its frames that does not outvote one that was found in a moved mean."""
_OF_FRAMES, _MOST_TIP_ODDS = 0.75, 4.0
"""How much of the frames' mean log-odds of the tip counts beside those of the judge, and how sure both are at most."""
_ASKED_FOR_DIRECTION = 20
"""How many frames before and after the seed say which direction its chains have."""


def track_chains(
    found: Sequence[FrameChains],
    frame_times_ms: Array,
    catheters: int,
    search: ChainSearch | None = None,
    seed: FrameChains | None = None,
    judge: TrackJudge | None = None,
    marks_first: bool = True,
) -> tuple[FrameChains, ...]:
    """Give the chains of a run track numbers.

    The tracks start at one frame and extend in both directions. The start is the first frame with a mark, else the
    seed, else the frame that most other frames confirm. In each frame:

    1. Each track predicts its chain from 0.6 of its last velocity.
    2. The chains of the frame are assigned to the predictions at the least total cost: mean shift, twice the largest change
    of
       shape, and a price for unlike kinds. Chains that are too far off are not assigned.
    3. ``search`` looks for a catheter that got no chain or a chain that bends too fast. Without success the track waits:
    the
       catheter may return with the next beat.

    Parameters
    ----------
    found : sequence of FrameChains
        Chains of each frame. Chains of a frame with ``manual_needed`` may continue a track but do not begin one.
    frame_times_ms : (n,)
    catheters : int
        Number of catheters in the catalogue: the largest number of chains of one frame.
    search : ChainSearch, optional
    seed : FrameChains, optional
        Chains in the mean of the frames round ``seed.frame``. They are more certain than the chains of a single frame.
    judge : TrackJudge, optional
        Decides about each track of four or more frames, and of half of the frames in short runs. Where it rejects one, the run is
        tracked again without the track's chains, twice at most. An accepted track has chains in half of the frames; one of six or
        more electrodes may get them from a search that needs their contrast only. All tracks are accepted by default.
    marks_first : bool
        Whether a frame with a mark precedes the seed. Not so where the seed's chains were already followed from the marks.

    Returns
    -------
    tuple of FrameChains
        ``manual_needed`` is MANUAL_NEEDED in a frame without chains. It is TRACK_INTERRUPTED in a frame that lacks a
        catheter which most frames have.
    """
    if not found:
        return ()
    seed = _as_frames_say(seed, found, frame_times_ms, catheters, marks_first)
    tracks = _follow(found, frame_times_ms, catheters, search, seed, marks_first)
    outvoted = [track for track in tracks if _is_outvoted(track, found)]
    if outvoted:
        found = [_without(entry, outvoted) for entry in found]
        kept = () if seed is None else tuple(chain for chain in seed.chains if not _starts(chain, seed.frame, outvoted))
        seed = None if seed is None else replace(seed, chains=kept)
        tracks = _follow(found, frame_times_ms, catheters, search, seed, marks_first)
    least = max(2.0, _SEEN_AT_LEAST * len(found)) if len(found) >= _LONG_RUN else 1.0
    if judge is not None:
        least = max(least, _ACCEPTED_AT_LEAST * len(found))
        tracks = _accepted(tracks, found, frame_times_ms, catheters, search, judge, marks_first)
    tracks_kept = [
        track
        for track in tracks
        if track.manual
        or track.detections >= least
        or (track.from_seed and len(track.chains) >= max(least, _RECOVERED_AT_LEAST * len(found)))
        or (judge is not None and len(track.chains) >= least)
    ]
    tracks_kept.sort(key=lambda track: -track.detections)
    if judge is not None and search is not None:
        rare = [track for track in tracks if track not in tracks_kept and len(track.chains) >= _judged_frames(found)]
        tracks_kept = completed(tracks_kept, rare, least, frame_times_ms, catheters, search, judge)
    if judge is not None and not any(needs_no_other(track) for track in tracks_kept):
        # Where none is clear, other things may lie like catheters.
        tracks_kept = []
    for track in tracks_kept:
        if not track.manual:
            track.chains = _from_tip(track)
        if search is not None and not track.manual:
            track.chains = with_common_shape(track.chains, _search_beside(track, tracks_kept, search))
        if track.verdict is not None and track.verdict.hidden:
            track.chains = _without_hidden(track, track.verdict.hidden)
    for number, track in enumerate(tracks_kept):
        if track.manual:
            track.chains = {frame: chain.on_track(number) for frame, chain in track.chains.items()}
        else:
            track.chains = with_common_kinds(track.chains, number)
    usual = [track for track in tracks_kept if len(track.chains) > len(found) / 2]
    entries = []
    for frame in range(len(found)):
        chains: list[Chain] = []
        for track in tracks_kept:
            chain = track.chains.get(frame)
            room = len(chains) < catheters or (chain is not None and chain.manual)
            if chain is not None and room and (chain.manual or not overlaps(chain, chains)):
                chains.append(chain)
        missing = any(frame not in track.chains for track in usual)
        reason = Reason.MANUAL_NEEDED if not chains else Reason.TRACK_INTERRUPTED if missing else None
        entries.append(FrameChains(frame, tuple(chains), reason))
    return tuple(entries)


def _as_frames_say(
    seed: FrameChains | None, found: Sequence[FrameChains], frame_times_ms: Array, catheters: int, marks_first: bool
) -> FrameChains | None:
    """Return the seed with each chain in the direction that the frames near it say.

    A chain in the wrong direction would be fitted again in each frame, with the tip's length at the wrong end.
    """
    if seed is None or not seed.chains:
        return seed
    near = [
        entry if abs(entry.frame - seed.frame) <= _ASKED_FOR_DIRECTION else FrameChains(entry.frame, ())
        for entry in found
    ]
    tracks = _follow(near, frame_times_ms, catheters, None, seed, marks_first)
    begun = [track for track in tracks if track.from_seed]
    if len(begun) < len(seed.chains):
        return seed
    chains = (reverse(chain) if track.direction < 0 else chain for chain, track in zip(seed.chains, begun, strict=True))
    return replace(seed, chains=tuple(chains))


def _follow(
    found: Sequence[FrameChains],
    frame_times_ms: Array,
    catheters: int,
    search: ChainSearch | None,
    seed: FrameChains | None,
    marks_first: bool,
) -> list[Track]:
    """Return all tracks, false ones too."""
    marked = [entry.frame for entry in found if any(chain.manual for chain in entry.chains)]
    tracks: list[Track] = []
    begun_with: tuple[Chain, ...] = ()
    if seed is not None and seed.chains and not (marked and marks_first):
        start = seed.frame
        at = float(frame_times_ms[start])
        begun_with = seed.chains
        tracks = [
            Track(chain, at, np.zeros(2), detections=0, from_seed=True, confirmed=not marks_first)
            for chain in begun_with
        ]
    else:
        start = marked[0] if marked else _start(found, catheters)
    for frames in (range(start, len(found)), range(start - 1, -1, -1)):
        if frames.step < 0:
            for track in tracks:
                first = min(track.chains, default=None)
                if first is None:
                    continue
                track.chain, track.time_ms = track.chains[first], float(frame_times_ms[first])
                track.velocity = _first_velocity(track.chains, frame_times_ms)
        for frame in frames:
            _advance(tracks, found[frame], float(frame_times_ms[frame]), catheters, search)
    for track, begun in zip(tracks, begun_with, strict=False):
        # A frame in which the seed was found again says of the tip what the seed says.
        again = track.chains.get(start)
        if again is not None and again.tip_odds is None:
            track.chains[start] = replace(again, tip_odds=begun.tip_odds)
    return tracks


def _accepted(
    tracks: list[Track],
    found: Sequence[FrameChains],
    frame_times_ms: Array,
    catheters: int,
    search: ChainSearch | None,
    judge: TrackJudge,
    marks_first: bool,
) -> list[Track]:
    """Return the tracks without wrong ones.

    A wrong track may have taken a catheter's place: the run is followed again without its chains, from the accepted tracks on.
    """
    judged = _judged_frames(found)
    confirmed: list[Track] = []
    rare: list[Track] = []
    for attempt in range(_MOST_RETRIES + 1):
        # Shorter tracks are dropped in any case.
        lasting = _lasting(tracks, len(found))
        asked = [track for track in tracks if not track.manual and len(track.chains) >= judged]
        for track in asked:
            track.verdict = judge(track.chains)
        wrong = [track for track in asked if not is_believed(track, lasting)]
        wrong += surplus([track for track in lasting if track not in wrong])
        tracks = [track for track in tracks if track not in wrong]
        found = [_without(entry, wrong) for entry in found]
        if not wrong or attempt == _MOST_RETRIES or not any(entry.chains for entry in found):
            break
        kept = [track for track in tracks if len(track.chains) >= judged]
        confirmed += [track for track in kept if track.confirmed]
        rare += [track for track in kept if track not in lasting]
        start = max(range(len(found)), key=lambda frame: sum(frame in track.chains for track in kept))
        seed = FrameChains(start, tuple(track.chains[start] for track in kept if start in track.chains))
        tracks = _follow(found, frame_times_ms, catheters, search, seed, marks_first)
    for track in confirmed:
        # Followed in another order, it may have ended at other places, and the judge may have rejected those.
        if not any(meet(track, other) for other in tracks):
            tracks.append(track)
    for track in rare:
        # Followed again, parts of it may have taken its frames.
        if all(len(other.chain.electrodes) < len(track.chain.electrodes) for other in tracks if meet(track, other)):
            tracks.append(track)
    left_over = surplus(_lasting(tracks, len(found)))
    return [track for track in tracks if track not in left_over]


def _lasting(tracks: Sequence[Track], frames: int) -> list[Track]:
    """Return the tracks that may be accepted in a run of so many frames."""
    return [track for track in tracks if track.manual or len(track.chains) >= _ACCEPTED_AT_LEAST * frames]


def _judged_frames(found: Sequence[FrameChains]) -> int:
    """Return in how many frames a track is judged."""
    return min(_JUDGED_FRAMES, math.ceil(_ACCEPTED_AT_LEAST * len(found)))


def _is_outvoted(track: Track, found: Sequence[FrameChains]) -> bool:
    """Return whether more frames show a longer or displaced chain there.

    They are compared with the frames that show the track's own chain. A chain of the seed or of the first frame can be a part of
    a longer catheter, or lie a pair of electrodes too far along its own, and would keep the catheter out of every frame.
    """
    against = 0
    for frame, chain in track.chains.items():
        against += found[frame].manual_needed is None and any(
            overlaps(chain, [other]) if len(other.electrodes) > len(chain.electrodes) else _is_displaced(chain, other)
            for other in found[frame].chains
            if other is not chain
        )
    # What a moved mean shows is more certain than a few frames that noise hides it in.
    most = _CONFIRMED_AGAINST * len(track.chains) if track.confirmed else _LEAST_AGAINST - 1
    return not track.manual and against > max(track.detections, most)


def _is_displaced(chain: Chain, other: Chain) -> bool:
    """Return whether a chain of as many electrodes lies farther along.

    It shares at least half of the places, and two or more of its electrodes are elsewhere.
    """
    count = len(chain.electrodes)
    if len(other.electrodes) != count:
        return False
    shared = count_shared(chain, other)
    return 2 * shared >= count and shared <= count - 2


def _starts(chain: Chain, frame: int, tracks: Sequence[Track]) -> bool:
    """Return whether one of these tracks began with this chain of the seed."""
    return any(track.from_seed and overlaps(chain, [track.chains[frame]]) for track in tracks if frame in track.chains)


def _without(entry: FrameChains, wrong: Sequence[Track]) -> FrameChains:
    """Return a frame's chains without those of wrong tracks."""
    places = [track.chains[entry.frame] for track in wrong if entry.frame in track.chains]
    return replace(
        entry,
        chains=tuple(
            chain
            for chain in entry.chains
            if chain.manual
            or all(
                chain.electrodes != place.electrodes or sum(chain_distance(chain, place)) > SAME_PLACE_PX
                for place in places
            )
        ),
    )


def _search_beside(track: Track, tracks: Sequence[Track], search: ChainSearch) -> ShapeSearch:
    """Return the search for a track's chain among the chains of the other tracks."""

    def beside(frame: int, chain: Chain, shift: Array, reach_px: float) -> Chain | None:
        taken = [other.chains[frame] for other in tracks if other is not track and frame in other.chains]
        return search(frame, chain, shift, reach_px, taken, same_shape=True)

    return beside


def _start(found: Sequence[FrameChains], catheters: int) -> int:
    sure = [entry for entry in found if entry.chains and entry.manual_needed is None]
    if not sure:
        return 0
    tried = sure[:: max(1, len(sure) // _CONFIRMERS)]
    sizes = {len(chain.electrodes) for entry in tried for chain in entry.chains}
    confirmed = np.zeros(len(tried))
    for size in sizes:
        rows = [
            (index, chain.pixels_uv)
            for index, entry in enumerate(tried)
            for chain in entry.chains
            if len(chain.electrodes) == size
        ]
        owner = np.array([index for index, _ in rows])
        places = np.array([points for _, points in rows])
        for index, points in rows:
            near = np.abs(places - points).max(axis=(1, 2)) < _CONFIRMED_PX
            confirmed[index] += len(set(owner[near].tolist())) - 1
    weakest = np.array(
        [
            min(float(np.median(chain.scores)) for chain in entry.chains) if len(entry.chains) >= catheters else 0.0
            for entry in tried
        ]
    )
    return tried[int(np.argmax(confirmed + 0.15 * np.minimum(weakest, 6.0)))].frame


def _first_velocity(chains: dict[int, Chain], frame_times_ms: Array) -> Array:
    first = min(chains)
    after = chains.get(first + 1)
    if after is None:
        return np.zeros(2)
    return (
        KEPT_VELOCITY
        * mean_shift(chains[first], after)
        / max(float(frame_times_ms[first + 1] - frame_times_ms[first]), 1e-6)
    )


def _advance(
    tracks: list[Track], entry: FrameChains, time_ms: float, catheters: int, search: ChainSearch | None
) -> None:  # fmt: skip
    numbers, turned = _assign(tracks, entry.chains, time_ms)
    by_hand = any(chain.manual for chain in entry.chains)
    present: list[Chain] = []
    bent: list[tuple[int, Chain]] = []
    if search is not None and not by_hand:
        sure = [
            chain
            for chain, number in zip(entry.chains, numbers, strict=True)
            if number >= 0 and tracks[number].confirmed
        ]
        for number, track in enumerate(tracks):
            if track.confirmed and number not in numbers:
                _search(track, entry, time_ms, catheters, search, present, sure)
        numbers = [
            -1 if number >= 0 and not tracks[number].confirmed and overlaps(chain, present) else number
            for chain, number in zip(entry.chains, numbers, strict=True)
        ]
    for chain, number, other_way in zip(entry.chains, numbers, turned, strict=True):
        if number < 0:
            continue
        tracks[number].detections += 1
        tracks[number].direction += -_tip_odds(chain) if other_way else _tip_odds(chain)
        if other_way:
            beside = [other for other in entry.chains if other is not chain]
            chain = reverse(chain)
            if search is not None and not by_hand:
                chain = _fitted_again(chain, entry.frame, beside, search)
        if search is not None and not by_hand and _is_bent(tracks[number], chain, time_ms):
            bent.append((number, chain))
        else:
            _extend(tracks[number], chain, entry.frame, time_ms)
            present.append(chain)
    for number, chain in bent:
        # One electrode of the chain may belong to another catheter.
        track = tracks[number]
        shift, reach = _expected(track, time_ms)
        recovered = search(entry.frame, track.chain, shift, reach, present) if search is not None else None
        if (
            recovered is not None
            and not _is_bent(track, recovered, time_ms)
            and not overlaps(recovered, present)
            and not _is_clearer(chain, recovered)
        ):
            chain = replace(recovered, kinds=chain.kinds, tip_odds=chain.tip_odds)
        _extend(track, chain, entry.frame, time_ms)
        present.append(chain)
    loose = [chain for chain, number in zip(entry.chains, numbers, strict=True) if number < 0]
    if search is not None and not by_hand:
        for number, track in enumerate(tracks):
            if number not in numbers and not track.confirmed:
                _search(track, entry, time_ms, catheters, search, present, loose=loose)
    for chain in loose:
        if chain.manual or (entry.manual_needed is None and not overlaps(chain, present)):
            present.append(chain)
            track = Track(chain, time_ms, np.zeros(2), manual=chain.manual, chains={entry.frame: chain})
            track.direction = _tip_odds(chain)
            tracks.append(track)


def _fitted_again(chain: Chain, frame: int, beside: Sequence[Chain], search: ChainSearch) -> Chain:
    """Fit a reversed chain again at its place.

    A tip is longer than a ring. The fit depends on the frame alone, so that a correction elsewhere in the run finds it stored.
    """
    again = search(frame, chain, np.zeros(2), _TURNED_REACH_PX, beside)
    if again is None or overlaps(again, beside):
        return chain
    return replace(again, kinds=chain.kinds, tip_odds=chain.tip_odds)


def _search(
    track: Track,
    entry: FrameChains,
    time_ms: float,
    catheters: int,
    search: ChainSearch,
    present: list[Chain],
    others: Sequence[Chain] = (),
    loose: Sequence[Chain] = (),
) -> None:
    """Search a track that got no chain of its frame.

    Where it is found, it is added to ``present``. ``others`` : chains that count as present, too. ``loose`` : the frame's chains
    on no track; a clearer one at the same place and within reach is taken.
    """
    taken = [*present, *others]
    if len(taken) >= catheters:
        return
    shift, reach = _expected(track, time_ms)
    recovered = search(entry.frame, track.chain, shift, reach, taken, confirmed=track.confirmed)
    if recovered is None or overlaps(recovered, taken):
        return
    for chain in loose:
        nearer = min((chain, reverse(chain)), key=lambda one: chain_distance(track.chain, one, shift))
        alike = chain.electrodes == recovered.electrodes and kind_overlap(track.chain, chain) > 0
        in_reach = chain_distance(track.chain, nearer, shift)[0] <= reach
        if alike and in_reach and overlaps(chain, [recovered]) and _is_clearer(chain, recovered):
            recovered = nearer
    is_faint = np.median(recovered.scores) < _FAINT * track.chain.scores.max()
    # Far from an old place there may be anything.
    if not is_faint or abs(time_ms - track.time_ms) < _STALE_MS:
        _extend(track, recovered, entry.frame, time_ms)
        present.append(recovered)


def _is_clearer(chain: Chain, recovered: Chain) -> bool:
    """Return whether a frame's own chain is clearer than a found one.

    After a frame with a wrong shape the search would find that shape again.
    """
    return bool(np.median(recovered.scores) < _AS_CLEAR * np.median(chain.scores))


def _from_tip(track: Track) -> dict[int, Chain]:
    """Return a track's chains, numbered from the end that is more likely the tip.

    Where the judge saw the shaft in the mean of many frames, that counts more than what single frames say.
    """
    odds, turned = _odds_of_direction(track), _is_turned(track)
    chains = {frame: reverse(chain) if turned else chain for frame, chain in track.chains.items()}
    if odds is None:
        return chains
    return {frame: replace(chain, tip_odds=abs(odds)) for frame, chain in chains.items()}


def _without_hidden(track: Track, hidden: Sequence[bool]) -> dict[int, Chain]:
    """Return chains, numbered from the tip, in which places without an electrode are unseen.

    hidden : of the track's places, in the order that its judge saw.
    """
    unseen = np.array(hidden[::-1] if _is_turned(track) else hidden)
    return {
        frame: chain
        if chain.manual or len(chain.scores) != len(unseen)
        else replace(chain, scores=np.where(unseen, UNSEEN, chain.scores))
        for frame, chain in track.chains.items()
    }


def _is_turned(track: Track) -> bool:
    """Return whether a track begins at the end that is less likely the tip."""
    odds = _odds_of_direction(track)
    return (track.direction if odds is None else odds) < 0


def _odds_of_direction(track: Track) -> float | None:
    """Return the log-odds that a track begins at its tip.

    None where its shaft says nothing.
    """
    verdict = track.verdict
    if verdict is None or verdict.tip_odds is None:
        return None
    of_frames = track.direction / max(track.detections, 1)
    return max(-_MOST_TIP_ODDS, min(_OF_FRAMES * of_frames + verdict.tip_odds, _MOST_TIP_ODDS))


def _tip_odds(chain: Chain) -> float:
    """Return the log-odds that a chain's tip is its first electrode.

    It is 1 where the chain says nothing.
    """
    return 1.0 if chain.tip_odds is None else chain.tip_odds


def _is_bent(track: Track, chain: Chain, time_ms: float) -> bool:
    """Return whether the shape changed faster than a heart bends a catheter."""
    elapsed = abs(time_ms - track.time_ms)
    return chain_distance(track.chain, chain)[1] > min(_STIFF_PX + _BENDING_PX_PER_MS * elapsed, _most_bent_px(elapsed))


def _most_bent_px(elapsed_ms: float) -> float:
    """Return how far a chain may bend in a time and still be the track's."""
    return min(max(_BEND_PX, _BEND_PX_PER_MS * elapsed_ms), _MOST_BEND_PX)


def _extend(track: Track, chain: Chain, frame: int, time_ms: float) -> None:
    elapsed = time_ms - track.time_ms
    if elapsed != 0:
        track.velocity = KEPT_VELOCITY * mean_shift(track.chain, chain) / elapsed
    track.chain, track.time_ms = chain, time_ms
    track.manual |= chain.manual
    track.chains[frame] = chain


def _expected(track: Track, time_ms: float) -> tuple[Array, float]:
    """Return the expected shift of a track and its largest error, pixels."""
    elapsed = time_ms - track.time_ms
    # An old velocity says nothing about where the heart is now.
    shift = track.velocity * elapsed if abs(elapsed) < _STALE_MS else np.zeros(2)
    return shift, farthest_px(abs(elapsed))


def _assign(tracks: Sequence[Track], chains: Sequence[Chain], time_ms: float) -> tuple[list[int], list[bool]]:
    """Return the track number of each chain and whether the chain is reversed.

    The number is -1 where no track fits.
    """
    if not chains or not tracks:
        return [-1] * len(chains), [False] * len(chains)
    cost = np.full((len(chains), len(tracks)), _IMPOSSIBLE)
    turned = np.zeros(cost.shape, dtype=np.bool_)
    others: dict[int, Chain] = {}
    for column, track in enumerate(tracks):
        shift, gate = _expected(track, time_ms)
        most_bent = _most_bent_px(abs(time_ms - track.time_ms))
        for row, chain in enumerate(chains):
            overlap = kind_overlap(track.chain, chain)
            if overlap <= 0:
                continue
            unlike = _OTHER_KIND * (1.0 - min(overlap, 1.0))
            away, bent = chain_distance(track.chain, chain, shift)
            if away <= gate and bent <= most_bent:
                cost[row, column] = away + 2.0 * bent + unlike
            elif not chain.manual and (away <= gate or chain.electrodes != track.chain.electrodes):
                # Turned, the same electrodes have the same mean shift.
                if row not in others:
                    others[row] = reverse(chain)
                away, bent = chain_distance(track.chain, others[row], shift)
                if away <= gate and bent <= most_bent:
                    cost[row, column] = away + 2.0 * bent + unlike + _REVERSED_PX
                    turned[row, column] = True
    numbers, other_way = [-1] * len(chains), [False] * len(chains)
    for taken_row, taken_column in zip(*linear_sum_assignment(cost), strict=True):
        if cost[taken_row, taken_column] < _IMPOSSIBLE:
            numbers[int(taken_row)] = int(taken_column)
            other_way[int(taken_row)] = bool(turned[taken_row, taken_column])
    return numbers, other_way
