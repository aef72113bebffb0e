"""Grey steps of neighbouring pixels: video coding removes the fine noise, so that most neighbours are alike."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import BoolArray, FrameSource
from fluoromap.segmenter.picture.field_mask import evenly_spaced_frames

_CODED_BITS = 8
_ASKED = 3


def usual_step(frames: FrameSource, inside: BoolArray, bits_stored: int) -> float:
    """Return by how many grey levels neighbouring pixels usually differ.

    It is a median over the field, between whole levels too, and then over a few frames. Up to half a level most neighbours are
    alike. Pixels at either end of a frame's levels do not count: they may be clipped. It is infinite for pixels of more than eight
    bits, which are no video.

    Parameters
    ----------
    frames : FrameSource
    inside : (rows, columns) bool
        The exposed field.
    bits_stored : int
        Significant bits of a pixel. Video has eight.
    """
    both = inside[:, 1:] & inside[:, :-1]
    if bits_stored > _CODED_BITS or not both.any():
        return math.inf
    return float(np.median([_step_of(frames[index], both) for index in evenly_spaced_frames(len(frames), _ASKED)]))


def _step_of(frame: NDArray[np.generic], both: BoolArray) -> float:
    levels = frame.astype(np.int32)
    first, second = levels[:, :-1][both], levels[:, 1:][both]
    within = (np.minimum(first, second) > levels.min()) & (np.maximum(first, second) < levels.max())
    steps = np.abs(second - first)[within]
    if not len(steps):
        return math.inf
    # A step of n levels lies anywhere between n - 0.5 and n + 0.5.
    shares = np.cumsum(np.bincount(steps)) / len(steps)
    return float(np.interp(0.5, np.concatenate([[0.0], shares]), np.concatenate([[0.0], 0.5 + np.arange(len(shares))])))
