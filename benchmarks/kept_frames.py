"""Rendered frames kept in memory, for the benchmarks that segment them: rendering is not what they measure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray


class KeptFrames:
    """A :class:`fluoromap.contracts.FrameSource` of frames (rows, columns) that are all there."""

    def __init__(self, frames: Iterable[NDArray[np.uint16]]) -> None:
        self._frames = list(frames)
        self.shape: tuple[int, int] = (self._frames[0].shape[0], self._frames[0].shape[1])

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> NDArray[np.uint16]:
        return self._frames[index]

    def __iter__(self) -> Iterator[NDArray[np.uint16]]:
        return iter(self._frames)
