"""Catheters followed along a run: chains of successive frames that are the same catheter get the same track number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.reasons import Reason

_SPEED_PX_PER_MS = 13.0 / 16.7
_FARTHEST_PX = 45.0
_NEAREST_PX = 13.0
_BEND_PX = 8.0
_STIFF_PX = 3.5
_BENDING_PX_PER_MS = 0.05
_KEPT_VELOCITY = 0.6
_STALE_MS = 50.0
_OTHER_KIND = 6.0
_IMPOSSIBLE = 1e6
_CONFIRMED_PX = 18.0
_CONFIRMERS = 60
_SAME_PLACE_PX = 4.0
_SEEN_AT_LEAST = 0.2
_CARRIED_AT_LEAST = 0.5
_LONG_RUN = 5
_REVERSED_PX = 4.0

Carry = Callable[[int, Chain, Array, float, Sequence[Chain]], Chain | None]
"""(frame, chain last seen, shift expected, reach in pixels, chains that stand in the frame) -> the chain in that frame."""


@dataclass(slots=True)
class _Track:
    """Where a catheter was met last; ``velocity`` in pixels a millisecond, forwards in time. detected : in how many frames,
    of which in ``reversed`` with the tip at the other end. seeded : stands in the seed."""

    chain: Chain
    time_ms: float
    velocity: Array
    detected: int = 1
    reversed: int = 0
    seeded: bool = False
    manual: bool = False
    chains: dict[int, Chain] = field(default_factory=dict)


def chain_distance(one: Chain, other: Chain, shift: Array | None = None) -> tuple[float, float]:
    """(mean shift, largest rest after that shift) in pixels over the electrodes both chains have; infinite without any."""
    if one.electrodes == other.electrodes:
        mine, theirs = one.pixels_uv, other.pixels_uv
    else:
        common = sorted(set(one.electrodes) & set(other.electrodes))
        if not common:
            return np.inf, np.inf
        mine = one.pixels_uv[[one.electrodes.index(number) for number in common]]
        theirs = other.pixels_uv[[other.electrodes.index(number) for number in common]]
    difference = theirs - mine if shift is None else theirs - mine - shift
    mean = difference.sum(axis=0) / len(difference)
    rest = difference - mean
    return float(np.sqrt(mean @ mean)), float(np.sqrt((rest * rest).sum(axis=1).max()))


def kind_overlap(one: Chain, other: Chain) -> float:
    """0 where the two cannot be the same catheter, 1 where their probabilities agree as far as they can."""
    agreement = sum(probability * other.probability(name) for name, probability in one.kinds)
    squares = [sum(probability**2 for _, probability in chain.kinds) for chain in (one, other)]
    return agreement / max(*squares, 1e-9)


def follow(
    found: Sequence[FrameChains],
    frame_times_ms: Array,
    catheters: int,
    carry: Carry | None = None,
    seed: FrameChains | None = None,
) -> tuple[FrameChains, ...]:
    """Give the chains of a run track numbers.

    Starts from the first frame marked by hand, else from the seed, else from the frame that most others confirm, and goes
    both ways. Each catheter is predicted by 0.6 of its last velocity and the chains of the frame are assigned to the
    predictions: least total cost (mean shift, twice the largest change of shape, a price for unlike kinds), gated. A
    catheter that no chain was assigned to, or one that bends too fast, is carried, where there is a way to; else its track
    waits: it comes back with the next beat.

    Parameters
    ----------
    found : sequence of FrameChains
        Chains of each frame. Those of a frame with ``manual_needed`` are not sure: they may continue a track, not begin one.
    frame_times_ms : (n,)
    catheters : int
        Of the catalogue: at most so many chains stand in a frame.
    carry : Carry, optional
    seed : FrameChains, optional
        What the mean of the frames round ``seed.frame`` shows, which is surer than any of them.

    Returns
    -------
    tuple of FrameChains
        ``manual_needed`` is MANUAL_NEEDED in a frame without chains, TRACK_INTERRUPTED where a catheter is missing that
        stands in most of the frames.
    """
    if not found:
        return ()
    marked = [entry.frame for entry in found if any(chain.manual for chain in entry.chains)]
    tracks: list[_Track] = []
    if seed is not None and seed.chains and not marked:
        start = seed.frame
        at = float(frame_times_ms[start])
        tracks = [_Track(chain, at, np.zeros(2), detected=0, seeded=True) for chain in seed.chains]
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
            _step(tracks, found[frame], float(frame_times_ms[frame]), catheters, carry)
    least = max(2.0, _SEEN_AT_LEAST * len(found)) if len(found) >= _LONG_RUN else 1.0
    lasting = [
        track
        for track in tracks
        if track.manual
        or track.detected >= least
        or (track.seeded and len(track.chains) >= max(least, _CARRIED_AT_LEAST * len(found)))
    ]
    lasting.sort(key=lambda track: -track.detected)
    for track in lasting:
        if 2 * track.reversed > track.detected and not track.manual:
            track.chains = {frame: _turned(chain) for frame, chain in track.chains.items()}
    usual = [track for track in lasting if len(track.chains) > len(found) / 2]
    entries = []
    for frame in range(len(found)):
        chains: list[Chain] = []
        for number, track in enumerate(lasting):
            chain = track.chains.get(frame)
            room = len(chains) < catheters or (chain is not None and chain.manual)
            if chain is not None and room and (chain.manual or not _covered(chain, chains)):
                chains.append(replace(chain, track=number))
        missing = any(frame not in track.chains for track in usual)
        reason = Reason.MANUAL_NEEDED if not chains else Reason.TRACK_INTERRUPTED if missing else None
        entries.append(FrameChains(frame, tuple(chains), reason))
    return tuple(entries)


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
        _KEPT_VELOCITY
        * _moved(chains[first], after)
        / max(float(frame_times_ms[first + 1] - frame_times_ms[first]), 1e-6)
    )


def _moved(one: Chain, other: Chain) -> Array:
    common = [number for number in one.electrodes if number in other.electrodes]
    if not common:
        return np.zeros(2)
    mine = one.pixels_uv[[one.electrodes.index(number) for number in common]]
    moved: Array = (other.pixels_uv[[other.electrodes.index(number) for number in common]] - mine).mean(axis=0)
    return moved


def _covered(chain: Chain, others: Sequence[Chain]) -> bool:
    """Whether two or more of its electrodes lie on those of another chain."""
    for other in others:
        apart = chain.pixels_uv[:, None, :] - other.pixels_uv[None, :, :]
        if np.count_nonzero((apart * apart).sum(axis=2).min(axis=1) < _SAME_PLACE_PX**2) >= 2:
            return True
    return False


def _step(tracks: list[_Track], entry: FrameChains, time_ms: float, catheters: int, carry: Carry | None) -> None:
    numbers, turned = _assign(tracks, entry.chains, time_ms)
    by_hand = any(chain.manual for chain in entry.chains)
    standing: list[Chain] = []
    bent: list[tuple[int, Chain]] = []
    for chain, number, other_way in zip(entry.chains, numbers, turned, strict=True):
        if number < 0:
            continue
        tracks[number].detected += 1
        if other_way:
            tracks[number].reversed += 1
            chain = _turned(chain)
        if carry is not None and not by_hand and (other_way or _is_bent(tracks[number], chain, time_ms)):
            bent.append((number, chain))
        else:
            _meet(tracks[number], chain, entry.frame, time_ms)
            standing.append(chain)
    for number, chain in bent:
        # One of its electrodes may be another catheter's.
        track = tracks[number]
        shift, reach = _expected(track, time_ms)
        carried = carry(entry.frame, track.chain, shift, reach, standing) if carry is not None else None
        if carried is not None and not _is_bent(track, carried, time_ms) and not _covered(carried, standing):
            chain = replace(carried, kinds=chain.kinds)
        _meet(track, chain, entry.frame, time_ms)
        standing.append(chain)
    loose = [chain for chain, number in zip(entry.chains, numbers, strict=True) if number < 0]
    if carry is not None and not by_hand:
        for number, track in enumerate(tracks):
            if number in numbers or len(standing) >= catheters:
                continue
            shift, reach = _expected(track, time_ms)
            carried = carry(entry.frame, track.chain, shift, reach, standing)
            if carried is not None and not _covered(carried, standing):
                _meet(track, carried, entry.frame, time_ms)
                standing.append(carried)
    for chain in loose:
        if chain.manual or (entry.manual_needed is None and not _covered(chain, standing)):
            standing.append(chain)
            tracks.append(_Track(chain, time_ms, np.zeros(2), manual=chain.manual, chains={entry.frame: chain}))


def _is_bent(track: _Track, chain: Chain, time_ms: float) -> bool:
    """Whether its shape changed by more than a heart bends a catheter in that time."""
    allowed = _STIFF_PX + _BENDING_PX_PER_MS * abs(time_ms - track.time_ms)
    return chain_distance(track.chain, chain)[1] > min(allowed, _BEND_PX)


def _meet(track: _Track, chain: Chain, frame: int, time_ms: float) -> None:
    elapsed = time_ms - track.time_ms
    if elapsed != 0:
        track.velocity = _KEPT_VELOCITY * _moved(track.chain, chain) / elapsed
    track.chain, track.time_ms = chain, time_ms
    track.manual |= chain.manual
    track.chains[frame] = chain


def _expected(track: _Track, time_ms: float) -> tuple[Array, float]:
    """Shift of a track since it was met last, and how far from there it may be."""
    elapsed = time_ms - track.time_ms
    # An old velocity says nothing about where the heart is now.
    shift = track.velocity * elapsed if abs(elapsed) < _STALE_MS else np.zeros(2)
    return shift, min(max(_NEAREST_PX, _SPEED_PX_PER_MS * abs(elapsed)), _FARTHEST_PX)


def _turned(chain: Chain) -> Chain:
    """The same chain with its tip at the other end."""
    return replace(
        chain, pixels_uv=chain.pixels_uv[::-1], covariance_px2=chain.covariance_px2[::-1], scores=chain.scores[::-1]
    )


def _assign(tracks: Sequence[_Track], chains: Sequence[Chain], time_ms: float) -> tuple[list[int], list[bool]]:
    """Track number of each chain, -1 where none fits, and whether it fits with its tip at the other end."""
    if not chains or not tracks:
        return [-1] * len(chains), [False] * len(chains)
    cost = np.full((len(chains), len(tracks)), _IMPOSSIBLE)
    turned = np.zeros(cost.shape, dtype=np.bool_)
    others: dict[int, Chain] = {}
    for column, track in enumerate(tracks):
        shift, gate = _expected(track, time_ms)
        for row, chain in enumerate(chains):
            overlap = kind_overlap(track.chain, chain)
            if overlap <= 0:
                continue
            unlike = _OTHER_KIND * (1.0 - min(overlap, 1.0))
            away, bent = chain_distance(track.chain, chain, shift)
            if away <= gate and bent <= _BEND_PX:
                cost[row, column] = away + 2.0 * bent + unlike
            elif not chain.manual:
                if row not in others:
                    others[row] = _turned(chain)
                away, bent = chain_distance(track.chain, others[row], shift)
                if away <= gate and bent <= _BEND_PX:
                    cost[row, column] = away + 2.0 * bent + unlike + _REVERSED_PX
                    turned[row, column] = True
    numbers, other_way = [-1] * len(chains), [False] * len(chains)
    for taken_row, taken_column in zip(*linear_sum_assignment(cost), strict=True):
        if cost[taken_row, taken_column] < _IMPOSSIBLE:
            numbers[int(taken_row)] = int(taken_column)
            other_way[int(taken_row)] = bool(turned[taken_row, taken_column])
    return numbers, other_way
