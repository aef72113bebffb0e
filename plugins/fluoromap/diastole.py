"""The quiet frames round diastole, from the motion of a run's frames.

Segmenters average them, and a simulated segmentation chooses the same ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from fluoromap.contracts import Array, BoolArray

MOST_AVERAGED = 7

_QUIET = 0.07
_UNSURE = 0.25
_LATE_PHASE = 0.55
_USUAL_CYCLE_MS = 800.0


def is_quiet(motion: Array) -> BoolArray:
    """Return which frames differ from the previous one by little more than noise, (n,).

    Motion and noise add in squares. The quietest fifth determines the noise, unless it moves already. A frame is quiet
    up to a fifteenth of the largest motion, or up to the motion that noise alone can cause.
    """
    if len(motion) < 3:
        return np.ones(len(motion), dtype=np.bool_)
    smooth = ndimage.median_filter(motion, 3, mode="nearest") if len(motion) >= 30 else motion
    noise = min(float(np.percentile(smooth, 20)), 1.1 * float(smooth.min()))
    moved = np.sqrt(np.maximum(smooth**2 - noise**2, 0.0))
    quiet: BoolArray = moved <= max(_QUIET * float(np.percentile(moved, 95)), _UNSURE * noise)
    return quiet


def quiet_stretches(motion: Array) -> tuple[tuple[int, int], ...]:
    """Return (first, last) frames between which nothing moves, in order.

    A stretch begins one frame before its first quiet difference: both frames of a small difference show the same place.
    """
    quiet = is_quiet(motion)
    stretches = []
    start: int | None = None
    for frame in range(1, len(motion) + 1):
        if frame < len(motion) and quiet[frame]:
            start = frame - 1 if start is None else start
        elif start is not None:
            stretches.append((start, frame - 1))
            start = None
    return tuple(stretches)


def diastolic_frames(motion: Array, frame_times_ms: Array, r_wave_frames: Sequence[int] = ()) -> tuple[int, ...]:
    """Return at most 7 frames round diastole that can be averaged, ascending.

    - Without R waves: the middle of the longest quiet stretch. The heart also rests at end-systole, but for a shorter time.
    - With R waves (RWavePointer, DICOM 0028,6040): the middle of the longest quiet stretch within the last 45 % before one.
    - Without a quiet stretch: the single quietest frame.
    """
    n = len(motion)
    if n < 3:
        return (n - 1,)
    late = _late_in_cycle(frame_times_ms, [frame for frame in r_wave_frames if 0 <= frame < n])
    stretches: list[list[int]] = []
    for first, last in quiet_stretches(motion):
        frames = [frame for frame in range(first, last + 1) if late[frame]]
        if len(frames) >= 2:
            stretches.append(frames)
    if not stretches:
        allowed = np.flatnonzero(late[1:]) + 1
        if not allowed.size:
            allowed = np.arange(1, n)
        return (int(allowed[np.argmin(motion[allowed])]),)
    longest = max(stretches, key=len)
    count = min(MOST_AVERAGED, len(longest))
    start = (len(longest) - count) // 2
    return tuple(longest[start : start + count])


def _late_in_cycle(frame_times_ms: Array, r_waves: Sequence[int]) -> BoolArray:
    if not r_waves:
        return np.ones(len(frame_times_ms), dtype=np.bool_)
    beats = frame_times_ms[sorted(set(r_waves))]
    cycle = float(np.median(np.diff(beats))) if len(beats) > 1 else _USUAL_CYCLE_MS
    edges = np.concatenate([[beats[0] - cycle], beats, [beats[-1] + cycle]])
    beat = np.clip(np.searchsorted(edges, frame_times_ms, side="right") - 1, 0, len(edges) - 2)
    phase = (frame_times_ms - edges[beat]) / np.maximum(edges[beat + 1] - edges[beat], 1e-9)
    late: BoolArray = (phase >= _LATE_PHASE) & (phase < 1.0)
    return late
