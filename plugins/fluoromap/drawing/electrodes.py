"""Found electrodes on a picture: a ring for each electrode, and the name of its catheter."""

from __future__ import annotations

from collections.abc import Mapping

from PIL import Image, ImageDraw

from fluoromap.contracts import Array
from fluoromap.drawing.lettering import BLACK, RGB, halo_text, text_size

CATHETERS_RGB: tuple[RGB, ...] = (
    (86, 180, 233), (240, 228, 66), (230, 159, 0), (204, 121, 167), (0, 158, 115), (213, 94, 0),
)  # fmt: skip
"""Colours that colour-blind readers can distinguish (M. Okabe and K. Ito); the pages use the same."""

RADIUS = 5.0
LETTERS = 11


def draw_electrodes(image: Image.Image, catheters: Mapping[str, Array], unit: float) -> None:
    """Draw the electrodes of each catheter at their places in the picture.

    Parameters
    ----------
    image : PIL image, RGB
    catheters : mapping
        Name -> (k, 2) places in the picture, from the tip on. The place of a name in the mapping gives its colour.
    unit : float
        Size of the picture's details, 1 for a picture of 512 pixels.
    """
    draw = ImageDraw.Draw(image)
    size, radius = max(9, round(LETTERS * unit)), RADIUS * unit
    for index, (name, places) in enumerate(catheters.items()):
        colour = CATHETERS_RGB[index % len(CATHETERS_RGB)]
        for u, v in places.tolist():
            for reach, ink, width in ((radius + unit, BLACK, 3 * unit), (radius, colour, 1.6 * unit)):
                draw.ellipse((u - reach, v - reach, u + reach, v + reach), outline=ink, width=max(1, round(width)))
        if len(places):
            u, v = places[0].tolist()
            width, _ = text_size(name, size)
            halo_text(draw, (u, v + radius + 0.9 * size), name, size, colour, BLACK)
