"""Completion of tracks: an accepted catheter is searched in the frames that lack it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fluoromap.contracts import Array
from fluoromap.segmenter.judge.verdict import TrackJudge, is_believed
from fluoromap.segmenter.shape.chain_comparison import mean_shift, overlaps
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES
from fluoromap.segmenter.tracks.track import KEPT_VELOCITY, ChainSearch, Track, farthest_px, meet
from fluoromap.segmenter.tracks.track_names import surplus

_NOT_SEEN_MS = 20.0
"""How long noise may hide a catheter before the search ends."""
_JUDGED_AGAIN = 1.25
"""How many times as many frames as before a track has when it is judged again."""


def completed(
    kept: Sequence[Track],
    rare: Sequence[Track],
    least: float,
    frame_times_ms: Array,
    catheters: int,
    search: ChainSearch,
    judge: TrackJudge,
) -> list[Track]:
    """Return the tracks with chains in the frames that lacked them.

    A track that many frames are added to is judged again: half of a run may look like a catheter where the whole run does not.

    Parameters
    ----------
    kept : sequence of Track
        Accepted tracks.
    rare : sequence of Track
        Tracks that too few frames show. A long one may replace tracks of its parts that have fewer electrodes together: anatomy
        rarely has so long a row. A short one needs a judge who believes it, and another catheter beside it. Both are judged again
        with the frames that the search adds.
    least : float
        In how many frames a track is seen.
    frame_times_ms : (n,)
    catheters : int
        Number of catheters in the catalogue: the largest number of chains of one frame.
    search : ChainSearch
    judge : TrackJudge
    """
    tracks = list(kept)
    wrong = []
    for track in tracks:
        if not track.manual:
            judged = len(track.chains)
            _complete(track, tracks, frame_times_ms, catheters, search)
            if len(track.chains) > _JUDGED_AGAIN * judged:
                track.verdict = judge(track.chains)
                wrong += [] if is_believed(track, kept) else [track]
    tracks = [track for track in tracks if track not in wrong]
    for track in sorted(rare, key=lambda track: -len(track.chains) * len(track.chain.electrodes)):
        parts = [other for other in tracks if _is_part(other, track)] if _is_long(track) else []
        explains_more = sum(len(other.chain.electrodes) for other in parts) < len(track.chain.electrodes)
        if not explains_more or not (_is_long(track) or _is_another(track, tracks)):
            continue
        others = [other for other in tracks if other not in parts]
        _complete(track, others, frame_times_ms, catheters, search)
        if len(track.chains) < least:
            continue
        track.verdict = judge(track.chains)
        if is_believed(track, others):
            tracks = [*others, track]
    return tracks


def _complete(
    track: Track, tracks: Sequence[Track], frame_times_ms: Array, catheters: int, search: ChainSearch
) -> None:
    """Search an accepted track in the frames that lack it.

    The search goes from one frame to the next and ends where a frame does not show the catheter; at 50 frames a second and more,
    where two in a row do not. The whole run shows it, so these frames only have to show its contrast.
    """
    for frames in (range(len(frame_times_ms)), range(len(frame_times_ms) - 1, -1, -1)):
        before: int | None = None
        moved: tuple[int, int] | None = None
        for frame in frames:
            if frame not in track.chains and before is not None:
                others = [other.chains[frame] for other in tracks if other is not track and frame in other.chains]
                since = abs(float(frame_times_ms[frame] - frame_times_ms[before]))
                if len(others) < catheters:
                    expected = np.zeros(2)
                    if moved is not None:
                        elapsed = abs(float(frame_times_ms[moved[1]] - frame_times_ms[moved[0]]))
                        shift = mean_shift(track.chains[moved[0]], track.chains[moved[1]])
                        expected = KEPT_VELOCITY * shift * (since / elapsed)
                    found = search(frame, track.chains[before], expected, farthest_px(since), others, confirmed=True)
                    if found is not None and not overlaps(found, others):
                        track.chains[frame] = found
            if frame not in track.chains:
                if before is not None and abs(frame_times_ms[frame] - frame_times_ms[before]) > _NOT_SEEN_MS:
                    before = None
                continue
            if before is not None:
                moved = before, frame
            before = frame


def _is_part(track: Track, other: Track) -> bool:
    """Return whether a track lies on electrodes of a track with more electrodes."""
    return not track.manual and len(track.chain.electrodes) < len(other.chain.electrodes) and meet(track, other)


def _is_another(track: Track, tracks: Sequence[Track]) -> bool:
    """Return whether a track is one more catheter beside these.

    The judge believes it, it does not meet them, and the study has a name left for it.
    """
    believed = track.verdict is not None and track.verdict.is_catheter
    return (
        bool(tracks) and believed and not any(meet(track, other) for other in tracks) and not surplus([*tracks, track])
    )


def _is_long(track: Track) -> bool:
    return len(track.chain.electrodes) >= MANY_ELECTRODES
