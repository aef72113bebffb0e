"""Rendered frames in memory, for benchmarks that segment frames and must not measure their rendering."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray


class MemoryFrames:
    """A :class:`fluoromap.contracts.FrameSource` of frames (rows, columns) in memory."""

    def __init__(self, frames: Iterable[NDArray[np.uint16]]) -> None:
        self._frames = list(frames)
        self.shape: tuple[int, int] = (self._frames[0].shape[0], self._frames[0].shape[1])

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> NDArray[np.uint16]:
        return self._frames[index]

    def __iter__(self) -> Iterator[NDArray[np.uint16]]:
        return iter(self._frames)
