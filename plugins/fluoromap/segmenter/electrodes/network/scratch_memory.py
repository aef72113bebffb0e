"""Memory for intermediate pictures that is used again: fresh memory costs a page fault for every 4 KiB."""

from __future__ import annotations

import math
import threading

import numpy as np

from fluoromap.segmenter.picture.log_image import Image


class ScratchMemory(threading.local):
    """Float32 arrays by name, separate for each thread.

    An array is valid until the same thread asks for one of the same name. Arrays above 64 MB are not stored.
    """

    _MOST = 16_000_000

    def __init__(self) -> None:
        self._stored: dict[str, Image] = {}
        self._inside: dict[str, tuple[tuple[int, ...], object]] = {}

    def array(self, name: str, *shape: int) -> Image:
        """Return an array with undefined content."""
        size = math.prod(shape)
        flat = self._stored.get(name)
        if flat is None or flat.size < size:
            flat = np.empty(size, np.float32)
            if size <= self._MOST:
                self._stored[name] = flat
        return flat[:size].reshape(shape)

    def around(self, name: str, inside: tuple[int, ...], *shape: int) -> Image:
        """Return an array with zeros around a picture of the shape ``inside``.

        The caller writes all pixels of the picture each time, and only these: the zeros stay for the next picture of this shape.
        """
        array = self.array(name, *shape)
        before = self._inside.get(name)
        if before is None or before[0] != inside or before[1] is not array.base:
            array.fill(0.0)
            self._inside[name] = inside, array.base
        return array
