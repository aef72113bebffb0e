"""Copies of labelled frames as another laboratory might have made them: turned, of another size, contrast, noise and compression.

A set of a few real frames may be found by luck. How many of its copies are found too says how near the limit it lies.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

Array = NDArray[np.float64]
Labels = dict[str, dict[int, Array]]

_SIZES, _GAMMAS, _CONTRASTS = (0.85, 1.6), (0.7, 1.45), (0.6, 1.4)
_MOST_SHARPENED, _SHARPENED_OVER_PX = 1.2, 2.0
_MOST_NOISE, _QUALITIES = 5.0, (45, 95)
_MIDDLE_GREY, _WHITE = 128.0, 255.0


def changed_copy(
    random: Generator, frames: Sequence[NDArray[np.uint8]], labels: Sequence[Labels]
) -> tuple[list[NDArray[np.uint8]], list[Labels], float]:
    """Return changed frames (rows, columns), their labels (pixels), and how much larger they are.

    All frames of a run are changed in the same way, but for noise and compression.
    """
    size, gamma, contrast = (math.exp(random.uniform(*np.log(limits))) for limits in (_SIZES, _GAMMAS, _CONTRASTS))
    sharpened, noise = random.uniform(0.0, _MOST_SHARPENED), random.uniform(0.0, _MOST_NOISE)
    quality = int(random.integers(*_QUALITIES))
    transposed, mirrored, flipped = (bool(random.integers(2)) for _ in range(3))
    last_row, last_column = frames[0].shape[0] - 1, frames[0].shape[1] - 1

    def changed(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        grey = frame[:: -1 if flipped else 1, :: -1 if mirrored else 1].astype(np.float32)
        grey = grey.T if transposed else grey
        shape = round(grey.shape[1] * size), round(grey.shape[0] * size)
        grey = np.asarray(Image.fromarray(grey).resize(shape, Image.Resampling.LANCZOS))
        grey = _WHITE * (np.clip(grey, 0.0, _WHITE) / _WHITE) ** gamma
        grey = _MIDDLE_GREY + contrast * (grey - _MIDDLE_GREY)
        grey = grey + sharpened * (grey - gaussian_filter(grey, _SHARPENED_OVER_PX))
        return _compressed(grey + random.normal(0.0, noise, grey.shape), quality)

    def moved(place: Array) -> Array:
        u, v = place
        there = np.array([last_column - u if mirrored else u, last_row - v if flipped else v])
        return (there[::-1] if transposed else there) * size + 0.5 * (size - 1.0)

    places = [
        {name: {number: moved(place) for number, place in electrodes.items()} for name, electrodes in of_frame.items()}
        for of_frame in labels
    ]
    return [changed(frame) for frame in frames], places, size


def _compressed(grey: Array, quality: int) -> NDArray[np.uint8]:
    stored = io.BytesIO()
    Image.fromarray(np.clip(np.rint(grey), 0.0, _WHITE).astype(np.uint8)).save(stored, "JPEG", quality=quality)
    return np.asarray(Image.open(stored))
