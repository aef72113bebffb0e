"""Animation of the activation that propagates over the wall."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from fluoromap.contracts import ChamberMap
from fluoromap.drawing.colours import Colours, scale_of
from fluoromap.drawing.overlay import Look, draw_overlay
from fluoromap.geometry import Camera

PICTURES = 24
PICTURE_MS = 120
LAST_PICTURE_MS = 1500
COLOURS = 256


def draw_propagation(
    frame: NDArray[np.uint8],
    camera: Camera,
    chamber: ChamberMap,
    shift_world_mm: ArrayLike,
    highlight_site: str,
    tip_uv: ArrayLike | None,
    look: Look,
) -> bytes:
    """Draw a GIF that runs through the map's times again and again.

    The parameters are those of :func:`fluoromap.drawing.overlay.draw_overlay`; ``look.until_ms`` is not used. Each picture
    is the overlay at one time, which is written in the corner. The wall is coloured where it is activated by that time.
    """
    times = look.times or scale_of(chamber, look.step_ms, look.palette)
    pictures = [
        Image.fromarray(
            draw_overlay(
                frame, camera, chamber, shift_world_mm, highlight_site, tip_uv, replace(look, until_ms=float(until_ms))
            )
        )
        for until_ms in np.linspace(times.start_ms, times.stop_ms, PICTURES)
    ]
    # All pictures share the palette of the last, which has every colour; unchanged pixels are then stored only once. The
    # colours of the colour bar are in it unchanged.
    palette = _palette(pictures[-1], times.band_colours())
    reduced = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    stream = io.BytesIO()
    shown_ms = [PICTURE_MS] * (PICTURES - 1) + [LAST_PICTURE_MS]
    reduced[0].save(
        stream, format="GIF", save_all=True, append_images=reduced[1:], duration=shown_ms, loop=0, disposal=1
    )
    return stream.getvalue()


def _palette(picture: Image.Image, bands: Colours) -> Image.Image:
    """Return an image with the palette of the pictures.

    It has the bands' colours (k, 3) unchanged, and the most important other colours of the picture.
    """
    free = COLOURS - len(bands)
    others = picture.quantize(free, dither=Image.Dither.NONE).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*bands.ravel().tolist(), *others[: 3 * free]])
    return palette
