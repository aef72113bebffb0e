"""Tracks: one catheter's chains along a run, and how chains of different frames compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.judge.verdict import Verdict
from fluoromap.segmenter.shape.chain_comparison import overlaps

KEPT_VELOCITY = 0.6
"""Share of a track's last velocity that is expected to last."""

_SPEED_PX_PER_MS = 13.0 / 16.7
_FARTHEST_PX = 45.0
_NEAREST_PX = 13.0


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
        """Return the chain in a frame; see :meth:`~fluoromap.segmenter.frames.detector.Detector.find_again`."""


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
