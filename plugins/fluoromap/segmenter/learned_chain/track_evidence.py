"""Whether a run shows a catheter along a track: the network judges pictures that are averaged along it.

Quantum noise makes the network doubt a catheter in single frames. The average of frames that are moved onto each other has little
noise: a catheter becomes clear in it, while beads of contrast medium stay as improbable as they are.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import affine_transform

from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.learned_chain.network_response import NetworkResponse, network_scale
from fluoromap.segmenter.learned_chain.resampling import resampled
from fluoromap.segmenter.learned_chain.weights import Trained
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.proposals import log_odds

_AVERAGED = 8
_PICTURES = 3
_MARGIN_PX = 40.0
_KEPT_FRAMES = _PICTURES * _AVERAGED
_LEAST_SHARE = 0.6
_LEAST_MEDIAN, _LEAST_LOW = 0.1, -1.5
_LOW_QUANTILE = 0.1


@dataclass(slots=True, eq=False)
class TrackEvidence:
    """Judge of the tracks of one run.

    frames : number of the run's frames.
    """

    trained: Trained
    px_per_mm: float
    frames: int
    _reduced: OrderedDict[int, Image] = field(default_factory=OrderedDict, init=False)

    def __call__(self, chains: Mapping[int, Chain], log_image: Callable[[int], Image]) -> bool:
        """Return whether the run shows a catheter where a track's chains (frame -> chain) are."""
        if len(chains) < _LEAST_SHARE * self.frames:
            return False
        numbers = sorted(chains)
        odds = np.array([self._log_odds(chains, group, log_image) for group in _groups(numbers)])
        low = np.quantile(odds.mean(axis=0), _LOW_QUANTILE, method="lower")
        return bool((np.median(odds, axis=1) >= _LEAST_MEDIAN).all() and low >= _LEAST_LOW)

    def _log_odds(
        self, chains: Mapping[int, Chain], group: Sequence[int], log_image: Callable[[int], Image]
    ) -> Array:
        scale = network_scale(self.px_per_mm)
        middle = chains[group[len(group) // 2]].pixels_uv
        first = np.floor(middle.min(axis=0) - _MARGIN_PX / scale)
        columns, rows = np.ceil((middle.max(axis=0) - first) * scale + _MARGIN_PX).astype(np.int64)
        total = np.zeros((rows, columns), np.float32)
        for frame in group:
            turn, shift = _similarity(middle, chains[frame].pixels_uv)
            offset = (turn @ first + shift + 0.5) * scale - 0.5
            small = self._small(frame, log_image, scale)
            total += affine_transform(small, turn[::-1, ::-1], offset[::-1], total.shape, order=1, mode="nearest")
        total /= len(group)
        seen = NetworkResponse.of_reduced(total, self.trained, scale)
        return log_odds(seen.probability_at(middle - first))


    def _small(self, frame: int, log_image: Callable[[int], Image], scale: float) -> Image:
        """Return a frame at the network's scale; the latest are kept for the other tracks."""
        small = self._reduced.get(frame)
        if small is None:
            small = self._reduced[frame] = resampled(log_image(frame), scale)
            if len(self._reduced) > _KEPT_FRAMES:
                self._reduced.popitem(last=False)
        return small


def _groups(frames: Sequence[int]) -> list[Sequence[int]]:
    """Return up to three groups of up to eight frames, evenly spread over a track."""
    size = min(_AVERAGED, len(frames))
    count = min(_PICTURES, -(-len(frames) // size))
    starts = np.linspace(0, len(frames) - size, count).astype(np.int64)
    return [frames[start : start + size] for start in starts]


def _similarity(points: Array, moved: Array) -> tuple[Array, Array]:
    """Return matrix (2, 2) and shift (2,) of the turn and scale that move the points best, (n, 2) each."""
    middle, to = points.mean(axis=0), moved.mean(axis=0)
    flat, other = ((side @ np.array([1.0, 1.0j])) for side in (points - middle, moved - to))
    factor = np.vdot(flat, other) / max(float(np.vdot(flat, flat).real), 1e-9)
    turn = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    return turn, to - turn @ middle
