"""Text and labels of the pictures."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from fluoromap.contracts import Array

Point = tuple[float, float]
Box = tuple[float, float, float, float]
RGB = tuple[int, int, int]
PHRASE_GAP = "    "
"""Between the phrases of a long text."""

WHITE: RGB = (255, 255, 255)
BLACK: RGB = (0, 0, 0)


@functools.cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's own typeface, so that pictures are the same on every machine."""
    return ImageFont.load_default(size=size)


@functools.lru_cache(maxsize=4096)
def text_size(text: str, size: int) -> tuple[int, int]:
    """Return width and height of a text, px."""
    left, top, right, bottom = font(size).getbbox(text)
    return round(right - left), round(bottom - top)


def halo_text(draw: ImageDraw.ImageDraw, middle: Point, text: str, size: int, ink: RGB, halo: RGB) -> None:
    """Draw a text centred on a point, to the nearest pixel.

    A rim keeps it legible on any background.
    """
    letters, with_rim = _masks(text, size)
    corner = round(middle[0]) - letters.width // 2, round(middle[1]) - letters.height // 2
    draw.bitmap(corner, with_rim, fill=halo)
    draw.bitmap(corner, letters, fill=ink)


@functools.lru_cache(maxsize=4096)
def _masks(text: str, size: int) -> tuple[Image.Image, Image.Image]:
    """Return the masks of a text, without and with a rim.

    Its middle is the middle of the masks. The pictures of a job show the same texts, and drawing letters takes longer than
    pasting them.
    """
    width, height = text_size(text, size)
    # Two sizes of room: letters may reach beyond the box about which they are centred.
    shape = (2 * (width // 2 + size) + 1, 2 * (height // 2 + size) + 1)
    masks = Image.new("L", shape), Image.new("L", shape)
    left, middle = math.floor(shape[0] // 2 - font(size).getlength(text) / 2), shape[1] // 2
    before = ""
    for phrase in text.split(PHRASE_GAP):
        phrase_masks, origin = _phrase_masks(phrase, size)
        corner = left + round(font(size).getlength(before)) - origin[0], middle - origin[1]
        for mask, phrase_mask in zip(masks, phrase_masks, strict=True):
            mask.paste(phrase_mask, corner)
        before += phrase + PHRASE_GAP
    return masks


@functools.lru_cache(maxsize=4096)
def _phrase_masks(phrase: str, size: int) -> tuple[tuple[Image.Image, Image.Image], tuple[int, int]]:
    """Return the masks of a phrase, without and with a rim.

    The second value is the left middle of the phrase in them. Captions differ in a few words: the other phrases are drawn once.
    """
    origin = size // 2, 2 * size
    shape = math.ceil(font(size).getlength(phrase)) + 2 * origin[0], 2 * origin[1] + 1
    masks = Image.new("L", shape), Image.new("L", shape)
    for mask, rim in zip(masks, (0, max(1, size // 9)), strict=True):
        ImageDraw.Draw(mask).text(origin, phrase, fill=255, font=font(size), anchor="lm", stroke_width=rim)
    return masks, origin


def line_with_squares(draw: ImageDraw.ImageDraw, middle: Point, text: str, size: int, ink: RGB) -> None:
    """Draw a text with squares, centred on a point.

    Each ``²`` is a small raised 2, because Pillow's typeface lacks the sign.
    """
    small = round(0.65 * size)
    parts = text.split("²")
    widths = [font(size).getlength(part) for part in parts]
    raised = font(small).getlength("2")
    u, v = middle[0] - (sum(widths) + raised * (len(parts) - 1)) / 2, middle[1]
    for index, (part, width) in enumerate(zip(parts, widths, strict=True)):
        if index:
            draw.text((u, v - 0.35 * size), "2", fill=ink, font=font(small), anchor="lm")
            u += raised
        draw.text((u, v), part, fill=ink, font=font(size), anchor="lm")
        u += width


_NEAR = np.array([(1, 0), (-1, 0), (0, -1), (0, 1), (0.8, -0.8), (0.8, 0.8), (-0.8, -0.8), (-0.8, 0.8)])
_DIRECTIONS = np.concatenate([_NEAR, 1.7 * _NEAR])


class Labels:
    """Labels of one picture, placed close beside their points with as little overlap as possible."""

    def __init__(self, width: int, height: int, taken: Iterable[Box] = ()) -> None:
        self._field = np.array([[0.0, 0.0, width, height]])
        self._taken = np.array(list(taken), dtype=np.float64).reshape(-1, 4)

    def place(self, point: Point, text: str, size: int, distance: float) -> Point:
        """Place a label and return its middle: the first of the directions with the least overlap."""
        box = np.array(text_size(text, size)) + size // 3
        middles = point + _DIRECTIONS * (distance + box / 2)
        boxes = np.concatenate([middles - box / 2, middles + box / 2], axis=1)
        outside = box.prod() - _overlaps(boxes, self._field)[:, 0]
        best = int((np.arange(len(boxes)) + 2 * outside + _overlaps(boxes, self._taken).sum(axis=1)).argmin())
        self._taken = np.concatenate([self._taken, boxes[best : best + 1]])
        u, v = middles[best].tolist()
        return u, v


def _overlaps(a: Array, b: Array) -> Array:
    """Return the areas (j, k) that boxes (j, 4) share with boxes (k, 4)."""
    low, high = np.maximum(a[:, None, :2], b[:, :2]), np.minimum(a[:, None, 2:], b[:, 2:])
    sides = np.maximum(high - low, 0.0)
    areas: Array = sides[..., 0] * sides[..., 1]
    return areas
