"""What publications do to a picture: resampling, sharpening, screens and grain, and the marks of authors."""

from __future__ import annotations

import io
import math

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFilter
from PIL.Image import Resampling

from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.training.drawing import Image
from fluoromap.training.randomness import between, chance

_FILTERS = Resampling.BILINEAR, Resampling.BICUBIC, Resampling.LANCZOS
_NAMES = "CS", "RV", "RA", "HRA", "His", "Abl", "LAA", "PV", "LASSO", "TEE", "A", "B", "1", "RAO", "LAO", "ICE", "*"
_WHITE, _BLACK = 255, 0


def printed(random: Generator, picture: PillowImage.Image) -> PillowImage.Image:
    """Return an 8 bit picture as a publication shows it, of the same size."""
    size = picture.width
    reduced = max(int(size * between(random, 0.6, 1.3)), 8)
    picture = picture.resize((reduced, reduced), _FILTERS[int(random.integers(3))])
    if chance(random, 0.4):
        picture = compressed(picture, int(between(random, 35.0, 90.0)))
    picture = picture.resize((size, size), _FILTERS[int(random.integers(3))])
    if chance(random, 0.5):
        picture = picture.filter(
            ImageFilter.UnsharpMask(between(random, 0.7, 3.0), int(between(random, 40.0, 160.0)), 0)
        )
    if chance(random, 0.4):
        levels = np.asarray(picture, np.float32)
        texture = _screen(random, size) if chance(random, 0.4) else _grain(random, size)
        levels = levels + np.float32(between(random, 0.05, 0.3)) * levels.std() * texture
        picture = PillowImage.fromarray(np.clip(levels, 0.0, 255.0).astype(np.uint8))
    if chance(random, 0.6):
        _annotate(random, picture)
    return picture


def compressed(picture: PillowImage.Image, quality: int) -> PillowImage.Image:
    """Return a picture as JPEG stores it."""
    stored = io.BytesIO()
    picture.save(stored, "JPEG", quality=quality)
    return PillowImage.open(stored)


def _screen(random: Generator, size: int) -> Image:
    """Draw the dots of a halftone screen, of standard deviation about 1."""
    angle, pace = between(random, 0.0, 1.6), 2.0 * math.pi / between(random, 2.0, 3.5)
    v, u = np.mgrid[:size, :size].astype(np.float32)
    cosine, sine = np.float32(pace * math.cos(angle)), np.float32(pace * math.sin(angle))
    dots = np.cos(cosine * u + sine * v) * np.cos(cosine * v - sine * u)
    return np.asarray(2.0 * dots, dtype=np.float32)


def _grain(random: Generator, size: int) -> Image:
    """Draw the grain of paper or film, of standard deviation 1."""
    blur = between(random, 0.4, 1.2)
    grain = gaussian(random.standard_normal((size, size), dtype=np.float32), blur)
    return grain / max(float(grain.std()), 1e-3)


def _annotate(random: Generator, picture: PillowImage.Image) -> None:
    """Draw names, arrows, lines and outlines as authors put them beside catheters."""
    draw = ImageDraw.Draw(picture)
    fill = _WHITE if chance(random, 0.7) else _BLACK
    for _ in range(int(random.integers(1, 4))):
        kind = random.random()
        at: NDArray[np.float64] = random.uniform(0.0, picture.width, 2)
        if kind < 0.45:
            draw.text(tuple(at.tolist()), str(random.choice(_NAMES)), fill=fill, font_size=between(random, 8.0, 22.0))
        elif kind < 0.8:
            _arrow(random, draw, at, fill)
        elif kind < 0.92:
            end = at + random.normal(size=2) * 30.0
            draw.line([*at.tolist(), *end.tolist()], fill, int(random.integers(1, 3)))
        else:
            reach = random.uniform(8.0, 40.0, 2)
            draw.ellipse([*(at - reach).tolist(), *(at + reach).tolist()], outline=fill)


def _arrow(random: Generator, draw: ImageDraw.ImageDraw, tip: NDArray[np.float64], fill: int) -> None:
    """Draw an arrow, or only its head."""
    angle, head = between(random, 0.0, 2.0 * math.pi), between(random, 3.0, 9.0)
    back = np.array([math.cos(angle), math.sin(angle)])
    side = np.array([-back[1], back[0]]) * between(random, 0.3, 0.7)
    corners = [tip, tip + head * (back + side), tip + head * (back - side)]
    draw.polygon([tuple(corner.tolist()) for corner in corners], fill=fill)
    if chance(random, 0.7):
        shaft = [tip + 0.9 * head * back, tip + head * between(random, 1.8, 5.0) * back]
        draw.line([tuple(end.tolist()) for end in shaft], fill, int(random.integers(1, 4)))
