"""Frames of a run for tests: an array as a frame source, and pictures as a laboratory shows and stores them."""

import io

import numpy as np
from PIL import Image


class Frames:
    """Frames in an array, as a frame source."""

    def __init__(self, frames):
        self._frames = np.asarray(frames)
        self.shape = self._frames.shape[1:]

    def __len__(self):
        return len(self._frames)

    def __getitem__(self, index):
        return self._frames[index]

    def __iter__(self):
        return iter(self._frames)


def displayed(frame, quality):
    """Return the frame as a laboratory stores it: logarithm, 8 bits, JPEG."""
    level = np.log(frame.astype(np.float64) + 1.0)
    low, high = np.percentile(level, [0.5, 99.5])
    stored = io.BytesIO()
    eight = (np.clip((level - low) / (high - low), 0.0, 1.0) * 255).astype(np.uint8)
    Image.fromarray(eight).save(stored, "JPEG", quality=quality)
    return np.asarray(Image.open(stored))
