"""Still frames: those round diastole in which no catheter moves, so that their mean shows each electrode once."""

from __future__ import annotations

from collections.abc import Sequence

from fluoromap.contracts import Array, FrameChains
from fluoromap.segmenter.shape.chain_comparison import chain_distance, reverse
from fluoromap.segmenter.tracks.track import farthest_px

_SAME_SHAPE_MM, _BLURRED_MM = 2.5, 1.0
"""How much a catheter may bend, and the motion from which on it is not averaged."""


def still_frames(
    frames: tuple[int, ...], found: Sequence[FrameChains], frame_times_ms: Array, px_per_mm: float
) -> tuple[int, ...]:
    """Return the frames round the middle one without motion of a catheter.

    In a short run or at a low frame rate the quietest frames may move too: their mean would show each electrode twice.
    """
    middle = frames[len(frames) // 2]

    def has_moved(frame: int) -> bool:
        elapsed = abs(float(frame_times_ms[frame] - frame_times_ms[middle]))
        return _has_moved(found[middle], found[frame], elapsed, px_per_mm)

    moved = [frame for frame in frames if has_moved(frame)]
    first = max((frame + 1 for frame in moved if frame < middle), default=frames[0])
    last = min((frame - 1 for frame in moved if frame > middle), default=frames[-1])
    return tuple(frame for frame in frames if first <= frame <= last)


def _has_moved(entry: FrameChains, other: FrameChains, elapsed_ms: float, px_per_mm: float) -> bool:
    """Return whether a catheter of one frame lies elsewhere in another."""
    for chain in entry.chains:
        alike = [again for again in other.chains if again.electrodes == chain.electrodes]
        distances = [chain_distance(chain, way) for again in alike for way in (again, reverse(again))]
        moved = [shift for shift, bent in distances if bent <= _SAME_SHAPE_MM * px_per_mm]
        if _BLURRED_MM * px_per_mm < min(moved, default=0.0) <= farthest_px(elapsed_ms):
            return True
    return False
