"""Words on a picture: site and direction of the view, orientation of the patient, and the meaning of the symbols."""

from __future__ import annotations

import math

import numpy as np
from PIL import Image, ImageDraw

from fluoromap.contracts import Array
from fluoromap.drawing.lettering import BLACK, PHRASE_GAP, WHITE, Box, halo_text, text_size
from fluoromap.geometry import Camera

LEGEND = PHRASE_GAP.join(["star: tip of this site", "dot: near wall", "ring: far wall"])
_ENDS = (("L", "R"), ("P", "A"), ("H", "F"))
"""Letters of the positive and negative ends of the axes of LPS."""
_LEAST_SHARE = 0.35
"""Smallest component of a unit vector that gets a letter."""


def purpose_text(*, simulated: bool) -> str:
    """Return the words that every picture carries about its data and its purpose."""
    return "simulated data, for research" if simulated else "for research"


def direction_text(camera: Camera) -> str:
    """Return the direction of a view, for example ``LAO 45 CRA 20``."""
    x, y, z = camera.axis_world.tolist()
    primary, secondary = math.degrees(math.atan2(x, -y)), math.degrees(math.asin(max(-1.0, min(1.0, z))))
    words = ["AP"] if abs(primary) < 0.5 else [f"{'LAO' if primary > 0 else 'RAO'} {abs(primary):.0f}"]
    if abs(secondary) >= 0.5:
        words.append(f"{'CRA' if secondary > 0 else 'CAU'} {abs(secondary):.0f}")
    return " ".join(words)


def orientation_letters(direction_world: Array) -> str:
    """Return the letters of a direction (3,), the largest component first.

    A hyphen separates them: ``R-A`` cannot be read as the right atrium.
    """
    unit = direction_world / np.linalg.norm(direction_world)
    order = np.argsort(-np.abs(unit))
    return "-".join(_ENDS[k][0 if unit[k] > 0 else 1] for k in order if abs(unit[k]) >= _LEAST_SHARE)


def image_directions(camera: Camera) -> tuple[Array, Array]:
    """Return the world directions (3,) to the right and downwards in the picture, at the isocentre."""
    jacobian = camera.jacobian(np.zeros(3))
    return jacobian[0], jacobian[1]


def annotation_boxes(picture: tuple[int, int], size: int, caption: str) -> list[Box]:
    """Return the places of caption and legend in a picture (width, height).

    Labels of sites avoid them.
    """
    width, height = picture
    reach = max(text_size(caption, size)[0], text_size(LEGEND, _small(size))[0])
    return [(0.0, height - 3.4 * size, min(width, reach + 1.5 * size), float(height))]


def draw_annotations(image: Image.Image, camera: Camera, caption: str, size: int) -> None:
    """Draw the caption and the legend at the bottom left, and the orientation at the edges."""
    draw = ImageDraw.Draw(image)
    width, height = image.size
    for text, letters, above in ((caption, size, 2.3), (LEGEND, _small(size), 0.95)):
        middle = (0.7 * size + text_size(text, letters)[0] / 2, height - above * size)
        halo_text(draw, middle, text, letters, WHITE, BLACK)
    right, down = image_directions(camera)
    level, beside_middle = 0.14 * height, 0.62 * width
    for place, direction in (
        ((1.6 * size, level), -right),
        ((width - 1.6 * size, level), right),
        ((beside_middle, 1.1 * size), -down),
    ):
        halo_text(draw, place, orientation_letters(direction), size, WHITE, BLACK)


def _small(size: int) -> int:
    return max(8, round(0.92 * size))
