"""What the network should answer to a scene: heat, offsets, tips, and where nobody could know."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from fluoromap.segmenter.electrodes.network.layers import CELL_PX
from fluoromap.segmenter.electrodes.network.normalisation import normalise
from fluoromap.training.drawing import Image
from fluoromap.training.randomness import chance
from fluoromap.training.scenes import CLEAR, Scene

_HEAT_SD_CELLS = 0.75
_OFFSETS_WITHIN = 2.1
_UNKNOWN_WITHIN = 4.0
_GAIN_SD = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A scene and its normalised picture, (size, size) float32."""

    scene: Scene
    picture: Image

    @classmethod
    def of_scene(cls, scene: Scene) -> Prepared:
        """Normalise a scene's picture."""
        return cls(scene, normalise(scene.pixels.astype(np.float32)))


def training_pair(random: Generator, prepared: Prepared) -> tuple[Image, Image]:
    """Return a scene's normalised picture, turned or mirrored at random, and its targets.

    Returns
    -------
    picture : (size, size). targets : (5, size / 2, size / 2), see :func:`~fluoromap.training.network.losses`.
    """
    scene, picture, places = prepared.scene, prepared.picture, prepared.scene.electrodes_uv.copy()
    # The grid starts at pixel 0: mirrored about the last pixel, every other place in a cell occurs as often.
    last = len(picture) - 1
    if chance(random, 0.5):
        picture, places[:, 0] = picture[:, ::-1], last - places[:, 0]
    if chance(random, 0.5):
        picture, places[:, 1] = picture[::-1], last - places[:, 1]
    if chance(random, 0.5):
        picture, places = picture.T, places[:, ::-1]
    gain = math.exp(float(random.normal()) * _GAIN_SD)
    return np.ascontiguousarray(picture) * np.float32(gain), _targets(scene, places, len(picture) // CELL_PX)


def _targets(scene: Scene, places: NDArray[np.float64], cells: int) -> Image:
    return _drawn_targets(places / CELL_PX, scene.tip.astype(np.float64), scene.clearness >= CLEAR, cells)


@numba.njit(cache=True, nogil=True)
def _drawn_targets(
    places: NDArray[np.float64], tips: NDArray[np.float64], clear: NDArray[np.bool_], cells: int
) -> Image:
    target = np.zeros((5, cells, cells), np.float32)
    unknown = np.zeros((cells, cells), np.bool_)
    closest = np.full((cells, cells), np.inf)
    for electrode in range(len(places)):
        a, b = places[electrode]
        for v in range(max(int(b) - 3, 0), min(int(b) + 5, cells)):
            for u in range(max(int(a) - 3, 0), min(int(a) + 5, cells)):
                square = (a - u) ** 2 + (b - v) ** 2
                if not clear[electrode]:
                    unknown[v, u] |= square < _UNKNOWN_WITHIN
                    continue
                heat = np.float32(math.exp(-0.5 * square / _HEAT_SD_CELLS**2))
                target[0, v, u] = max(target[0, v, u], heat)
                if square < closest[v, u] and square < _OFFSETS_WITHIN:
                    closest[v, u] = square
                    target[1, v, u] = a - u
                    target[2, v, u] = b - v
                    target[3, v, u] = tips[electrode]
                    target[4, v, u] = 1.0
        row, column = round(b), round(a)
        if clear[electrode] and 0 <= row < cells and 0 <= column < cells:
            target[0, row, column] = 1.0
    for v in range(cells):
        for u in range(cells):
            if unknown[v, u] and target[0, v, u] < 0.3:
                target[0, v, u] = -1.0
    return target
