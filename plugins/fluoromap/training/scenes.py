"""Synthetic fluoroscopy scenes: pictures and the places of all electrodes in them, from a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array
from fluoromap.training.anatomy import anatomy, from_backgrounds
from fluoromap.training.appearance import Picture, take_picture
from fluoromap.training.distractors import draw_distractors
from fluoromap.training.drawing import Canvas, Image
from fluoromap.training.drawn_catheters import LABEL_COLUMNS, draw_catheters, random_design
from fluoromap.training.exposure import random_exposure
from fluoromap.training.leads import draw_lead
from fluoromap.training.randomness import between, chance, scaled, whole

SCALES_PX_PER_MM = 2.3, 4.6
"""Of the pictures; the network sees frames of 3.0 to 6.5 px/mm reduced to its own scale, and that scale is often misjudged."""
CLEAR = 6.5
"""Contrast over noise, summed over an electrode, from which on the network has to find it."""

CLINICAL_CROWD = 0.7
"""Catheters where they are as dense as in a laboratory: 10 cm x 10 cm of a frame have three or four."""

_WITHOUT_CATHETER = 0.28
_CATHETERS = 1, 1, 2, 2, 3
_LEADS = 0.15
_CALIBRATED_PX = 160.0
"""Size of a scene for which numbers of things hold; a larger one has more, so that they lie as densely."""
_OWN_BACKGROUND = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One picture with its truth.

    pixels : (size, size) uint8. electrodes_uv : (n, 2) pixels. tip : (n,) bool. clearness : (n,) contrast over noise of each
    electrode; below :data:`CLEAR` nobody could find it.
    """

    pixels: NDArray[np.uint8]
    electrodes_uv: Array
    tip: NDArray[np.bool_]
    clearness: Array


def make_scene(
    random: Generator,
    size: int,
    catalogue: Sequence[Catheter] = (),
    backgrounds: Sequence[Image] = (),
    crowd: float = 1.0,
) -> Scene:
    """Draw one scene.

    Parameters
    ----------
    random : Generator
        The scene depends on nothing else.
    size : int
        Rows and columns.
    catalogue : sequence of Catheter
        A lab's own catheters, used for half of those drawn.
    backgrounds : sequence of (rows, columns) attenuations
        A lab's own electrode-free frames, used for 6 scenes of 10.
    crowd : float
        Catheters over those that scenes to learn from have.
    """
    px_per_mm = scaled(random, *SCALES_PX_PER_MM)
    exposure = random_exposure(random)
    canvas = Canvas.empty(size)
    in_front = chance(random, 0.5)
    if in_front:
        draw_distractors(random, canvas, px_per_mm, size / _CALIBRATED_PX)
    drawn = np.zeros((0, LABEL_COLUMNS))
    if not chance(random, _WITHOUT_CATHETER):
        count = whole(random, crowd * float(random.choice(_CATHETERS)) * size * size / _CALIBRATED_PX**2)
        designs = [random_design(random, catalogue) for _ in range(max(count, 1))]
        drawn = draw_catheters(random, canvas, px_per_mm, designs, exposure.metal)
    for _ in range(whole(random, _LEADS * size / _CALIBRATED_PX)):
        drawn = np.concatenate([drawn, draw_lead(random, canvas, px_per_mm)])
    if not in_front:
        draw_distractors(random, canvas, px_per_mm, size / _CALIBRATED_PX)
    if backgrounds and chance(random, _OWN_BACKGROUND):
        body = from_backgrounds(random, size, backgrounds) + between(random, 0.0, 0.6) * anatomy(
            random, size, px_per_mm, exposure.frontal
        )
    else:
        body = anatomy(random, size, px_per_mm, exposure.frontal)
    picture = take_picture(random, canvas.depth, body, exposure)
    inside = ((drawn[:, :2] > -8.0) & (drawn[:, :2] < size + 8.0)).all(axis=1)
    drawn = drawn[inside]
    clearness = _clearness(picture, drawn) / (1.0 + exposure.scatter)
    return Scene(picture.pixels, drawn[:, :2], drawn[:, 2] > 0, clearness)


def _clearness(picture: Picture, drawn: Array) -> Array:
    """Return how clearly each electrode shows.

    It is the contrast over noise, times the root of its area; 0 where the picture is black, white or flat.
    """
    size = len(picture.pixels)
    u, v = np.clip(np.rint(drawn[:, :2]), 0, size - 1).astype(np.int64).T
    attenuation, half, radius = drawn[:, 3:].T
    light = picture.transmitted[v, u]
    area = np.sqrt(np.maximum(4.0 * half * radius, 1.0))
    clearness: Array = (1.0 - np.exp(-attenuation)) * area * np.sqrt(np.maximum(light, 0.0)) / max(picture.noise, 1e-3)
    clearness[light < 0.07] = 0.0
    for index, (cu, cv) in enumerate(zip(u.tolist(), v.tolist(), strict=True)):
        near = picture.pixels[max(cv - 7, 0) : cv + 8, max(cu - 7, 0) : cu + 8].astype(np.float64)
        middle = picture.pixels[max(cv - 1, 0) : cv + 2, max(cu - 1, 0) : cu + 2].astype(np.float64)
        if abs(float(near.mean()) - float(middle.mean())) < 1.5 and float(near.std()) < 3.0:
            clearness[index] = 0.0
    return clearness
