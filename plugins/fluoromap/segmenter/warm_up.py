"""What a worker does before its first run: it compiles the kernels and segments a small synthetic run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue
from fluoromap.contracts import PixelFacts, Run, Segmenter, Silent
from fluoromap.segmenter.kernels import compile_kernels

_PX_PER_MM = 5.75
_FRAME_MS = 1000.0 / 15
_FRAMES = 5
_HIDDEN_IN = 2
_LEVEL, _SHAFT, _ELECTRODE = 1000.0, 0.9, 0.45


class SyntheticFrames:
    """Frames with straight catheters side by side, one pixel lower in each frame.

    The last catheter is absent from one frame, so that the segmenter has to search for it. Stored pixels are 12 bits in
    16, with the noise of 1000 photons.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        longest = max(float(catheter.arc_lengths_mm[-1]) for catheter in catalogue.catheters)
        self.shape = (round(longest * _PX_PER_MM) + 128, 64 * (len(catalogue.catheters) + 1))

    def __len__(self) -> int:
        return _FRAMES

    def __getitem__(self, index: int) -> NDArray[np.uint16]:
        if not 0 <= index < _FRAMES:
            raise IndexError(f"frame {index} of {len(self)}")
        v, u = np.ogrid[0 : self.shape[0], 0 : self.shape[1]]
        level = np.full(self.shape, _LEVEL)
        shown = self._catalogue.catheters[: -1 if index == _HIDDEN_IN else None]
        for place, catheter in enumerate(shown, 1):
            along = v - 40.0 - index
            across = abs(u - 64.0 * place) < _PX_PER_MM
            level[(along >= 0) & across] *= _SHAFT
            for electrode, at in enumerate(catheter.arc_lengths_mm):
                half = 0.5 * _PX_PER_MM * (catheter.tip_mm if electrode == 0 else catheter.ring_mm)
                level[(abs(along - at * _PX_PER_MM) <= half) & across] *= _ELECTRODE
        return np.random.default_rng(index).poisson(level).astype(np.uint16)

    def __iter__(self) -> Iterator[NDArray[np.uint16]]:
        return (self[index] for index in range(_FRAMES))


def prepare(segmenter: Segmenter) -> None:
    """Compile the kernels, or load them from the cache, and segment the synthetic run."""
    compile_kernels()
    run = Run(
        SyntheticFrames(DEFAULT_CATALOGUE),
        np.arange(_FRAMES, dtype=np.float64) * _FRAME_MS,
        _PX_PER_MM,
        PixelFacts(logarithmic=False, bits_stored=12, monochrome1=False),
    )
    segmenter.segment(run, DEFAULT_CATALOGUE, {}, Silent())
