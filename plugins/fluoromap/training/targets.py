"""What the network should answer to a scene: heat, offsets, tips, and where nobody could know."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from fluoromap.segmenter.learned_chain.layers import CELL_PX
from fluoromap.segmenter.learned_chain.normalisation import normalise
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
    target = np.zeros((5, cells, cells), np.float32)
    unknown = np.zeros((cells, cells), np.bool_)
    closest = np.full((cells, cells), np.inf)
    for (a, b), tip, clearness in zip(places / CELL_PX, scene.tip, scene.clearness, strict=True):
        u0, u1, v0, v1 = max(int(a) - 3, 0), min(int(a) + 5, cells), max(int(b) - 3, 0), min(int(b) + 5, cells)
        if u0 >= u1 or v0 >= v1:
            continue
        du, dv = a - np.arange(u0, u1), (b - np.arange(v0, v1))[:, None]
        squares = du**2 + dv**2
        if clearness < CLEAR:
            unknown[v0:v1, u0:u1] |= squares < _UNKNOWN_WITHIN
            continue
        part = target[:, v0:v1, u0:u1]
        np.maximum(part[0], np.exp(-0.5 * squares / _HEAT_SD_CELLS**2), out=part[0])
        own = (squares < closest[v0:v1, u0:u1]) & (squares < _OFFSETS_WITHIN)
        closest[v0:v1, u0:u1][own] = squares[own]
        part[1][own] = np.broadcast_to(du, own.shape)[own]
        part[2][own] = np.broadcast_to(dv, own.shape)[own]
        part[3][own] = tip
        part[4][own] = 1.0
        row, column = round(float(b)), round(float(a))
        if 0 <= row < cells and 0 <= column < cells:
            target[0, row, column] = 1.0
    target[0][unknown & (target[0] < 0.3)] = -1.0
    return target
