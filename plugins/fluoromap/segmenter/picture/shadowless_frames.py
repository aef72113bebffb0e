"""Frames without the shadow that a recursive noise filter leaves of the frame before."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import FrameSource
from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.segmenter.picture.log_image import Image

_AROUND_PX = 1.5
_SAMPLED = np.s_[::4, ::4]
_NOISE_GAIN = 3.0
"""Over the usual squared difference of two frames. What differs less is noise, which stays filtered."""
_TINY = np.float32(1e-6)


class ShadowlessFrames:
    """Frames of a run after the inverse of its recursive filter, where something moves.

    The filter is y(t) = lag y(t - 1) + (1 - lag) x(t), so x(t) = y(t) + lag / (1 - lag) (y(t) - y(t - 1)). At each pixel the
    difference counts as far as it is more than noise (Wiener's filter), since all of it would amplify the noise. The first frame
    has no frame before, so it keeps its shadow.

    Parameters
    ----------
    frames : FrameSource
    lag : float
        See :func:`~fluoromap.segmenter.picture.lag.measure_lag`, below 1.
    bits_stored : int
        Significant bits of a pixel.
    """

    def __init__(self, frames: FrameSource, lag: float, bits_stored: int) -> None:
        self._frames = frames
        self._highest = 2.0**bits_stored - 1.0
        self._gain = np.float32(lag / (1.0 - lag))
        self._latest: tuple[int, NDArray[np.generic]] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self._frames.shape

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[NDArray[np.generic]]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> NDArray[np.generic]:
        """Return the pixels of frame ``index`` in the type that they are stored in."""
        if self._latest is None or self._latest[0] != index:
            self._latest = index, self._without_shadow(index)
        return self._latest[1]

    def _without_shadow(self, index: int) -> NDArray[np.generic]:
        frame = self._frames[index]
        if index == 0:
            return frame
        seen = frame.astype(np.float32)
        differs: Image = seen - self._frames[index - 1].astype(np.float32)
        square = gaussian(differs * differs, _AROUND_PX)
        noise = np.float32(_NOISE_GAIN * np.median(square[_SAMPLED]))
        share = np.maximum(np.float32(1.0) - noise / np.maximum(square, _TINY), np.float32(0.0))
        seen += self._gain * share * differs
        return np.rint(np.clip(seen, 0.0, self._highest)).astype(frame.dtype)
