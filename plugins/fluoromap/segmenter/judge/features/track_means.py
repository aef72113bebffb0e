"""The evidence for electrodes in the mean of frames that are moved along a track.

Quantum noise makes the network doubt a catheter in single frames. The average of frames that are moved onto each other has little
noise: a catheter becomes clear in it, while beads of contrast medium stay as improbable as they are.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from fluoromap.contracts import Array, IntArray
from fluoromap.segmenter.electrodes.network.network_response import NetworkResponse, network_scale
from fluoromap.segmenter.electrodes.network.weights import Trained
from fluoromap.segmenter.electrodes.proposals import log_odds
from fluoromap.segmenter.judge.features.bars import ACROSS_MM, BESIDE_MM, products_beside
from fluoromap.segmenter.judge.features.dark_lines import depths_along, depths_beyond
from fluoromap.segmenter.judge.features.shaft_ends import shafts_at_ends
from fluoromap.segmenter.judge.features.unexplained_rows import EVEN_ODDS
from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.picture.resampling import add_moved, resampled
from fluoromap.segmenter.picture.shaft_image import ShaftImage

_AVERAGED = 8
_ORIENTATIONS = 2
_SCALES = 1.0, 0.87
"""Over that of the network. What it says at one scale and denies at the other is luck."""
_PICTURES = 2
_MARGIN_PX = 40.0
_SECTION = 5
_KEPT_FRAMES = _PICTURES * _AVERAGED
_SMOOTH_PX = 1.0
_SHAFT = 0.03
"""Depth of a clear shaft, log units."""


@dataclass(frozen=True, eq=False)
class SectionOdds:
    """The evidence for a part of a track, in the mean of some frames.

    log_odds : (n,) of its electrodes. beside, across : see :func:`~fluoromap.segmenter.judge.features.bars.products_beside`, for
    its two sets of distances. depths : see :func:`~fluoromap.segmenter.judge.features.dark_lines.depths_along`. shafts : see
    :func:`~fluoromap.segmenter.judge.features.shaft_ends.shafts_at_ends`. beyond : see
    :func:`~fluoromap.segmenter.judge.features.dark_lines.depths_beyond`. tips : (2,) the network's logits of a tip at the first
    and the last electrode. near_uv, near_odds : (m, 2) places and (m,) log-odds of all electrodes of the picture, in the frame of
    its places.
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
class TrackMeans:
    """Means of the frames of one run along its tracks, at the network's scale."""

    trained: Trained
    px_per_mm: float
    _reduced: OrderedDict[int, Image] = field(default_factory=OrderedDict, init=False)

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


def first_and_last(frames: int) -> list[IntArray]:
    """Return the first and the last eight of a track's frames."""
    size = min(_AVERAGED, frames)
    count = min(_PICTURES, -(-frames // size))
    return [start + np.arange(size) for start in np.linspace(0, frames - size, count).astype(np.int64).tolist()]


def all_along(frames: int) -> IntArray:
    """Return sixteen frames of a track, evenly over it.

    Motion between them blurs the anatomy, which hides a catheter at rest.
    """
    return np.linspace(0, frames - 1, min(frames, _PICTURES * _AVERAGED)).astype(np.int64)


def in_sections(path_uv: Array) -> list[Array]:
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
