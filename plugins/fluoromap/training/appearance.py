"""From attenuation to the picture that a lab stores: X-ray physics, detector, grey levels, vendor's processing, compression."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw

from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.training.drawing import Image
from fluoromap.training.exposure import Exposure
from fluoromap.training.printing import compressed, printed
from fluoromap.training.randomness import between, chance, scaled, smooth_field

_LETTERS = "ABLRAO0123456789.mmsTIHx+-:/"


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One picture and what its noise hides.

    pixels : (size, size) uint8. noise : standard deviation over intensity at a place of mean brightness.
    transmitted : (size, size) slow part of the intensity over its mean.
    """

    pixels: NDArray[np.uint8]
    noise: float
    transmitted: Image


def take_picture(random: Generator, things: Image, body: Image, exposure: Exposure) -> Picture:
    """Make the picture of a body with things in it.

    Both are attenuations, (size, size) log units.
    """
    size = len(things)
    focus = between(random, 0.25, 0.9) if chance(random, 0.8) else between(random, 0.9, 1.6)
    attenuation = body + np.maximum(gaussian(things, focus), 0.0) * np.float32(between(random, 0.75, 1.0))
    attenuation -= attenuation.mean()
    if chance(random, 0.1):
        attenuation += _collimator(random, size)
    intensity = np.exp(-np.clip(attenuation, -3.0, 6.0))
    scatter = np.float32(exposure.scatter)
    intensity = (intensity + scatter * gaussian(intensity, 15.0)) / (1.0 + scatter)
    intensity /= intensity.mean()
    noise = exposure.noise(random, intensity)
    seen = np.maximum(intensity + noise, 1e-3)
    if exposure.plain:
        return Picture(_scaled_to_8_bits(np.log(seen)), float(noise.std()), gaussian(intensity, 4.0))
    grey = _grey_levels(random, seen)
    if chance(random, 0.5):
        grey += np.float32(between(random, 0.2, 2.5)) * (grey - gaussian(grey, between(random, 0.8, 6.0)))
    if chance(random, 0.15):
        grey = gaussian(grey, between(random, 0.5, 1.3))
    return Picture(_stored(random, grey, exposure.printed), float(noise.std()), gaussian(intensity, 4.0))


def _collimator(random: Generator, size: int) -> Image:
    v, u = np.mgrid[:size, :size].astype(np.float32) - 0.5 * size
    angle = between(random, 0.0, 2.0 * math.pi)
    beyond = u * math.cos(angle) + v * math.sin(angle) - between(random, 0.2, 0.6) * size
    edge: Image = between(random, 0.8, 4.0) / (1.0 + np.exp(-np.clip(beyond / between(random, 0.5, 4.0), -40.0, 40.0)))
    return edge


def _scaled_to_8_bits(logarithm: Image) -> NDArray[np.uint8]:
    """Convert a 12 bit picture's logarithm to the scene's 8 bits.

    Noise of an exposure that is stored so is many levels wide: nothing is lost.
    """
    low, high = np.percentile(logarithm[::2, ::2], [0.05, 99.95])
    levels = np.clip((logarithm - low) / (high - low + 1e-9), 0.0, 1.0) * 255.0
    return np.asarray(np.rint(levels), dtype=np.uint8)


def _grey_levels(random: Generator, intensity: Image) -> Image:
    kind = random.random()
    if kind < 0.4:
        return intensity
    if kind < 0.75:
        logarithm: Image = np.log(intensity + np.float32(scaled(random, 0.01, 0.3)))
        return logarithm
    power: Image = intensity ** np.float32(between(random, 0.35, 1.6))
    return power


def _stored(random: Generator, grey: Image, in_print: bool) -> NDArray[np.uint8]:
    """Convert grey values to a stored picture.

    The steps are window, local vendor contrast, burnt-in text, 8 bit, a publication's print, and JPEG.
    """
    if chance(random, 0.1):
        grey = grey * (1.0 + between(random, 0.0, 0.3) * smooth_field(random, len(grey), 40.0))
    hard = 2.0 if in_print else 1.0
    low, high = np.percentile(
        grey[::2, ::2], [between(random, 0.0, 2.0 * hard), 100.0 - between(random, 0.0, 2.0 * hard)]
    )
    width = (high - low) * (between(random, 1.0, 3.0) if chance(random, 0.6 / hard) else 1.0) + 1e-9
    start = between(random, 0.0, 1.0) * (width - (high - low))
    levels = np.clip((grey - low + start) / width, 0.0, 1.0) * 255.0
    picture = PillowImage.fromarray(levels.astype(np.uint8))
    if chance(random, 0.1):
        text = "".join(random.choice(list(_LETTERS), int(random.integers(2, 9))))
        u, v = random.integers(-10, len(grey), 2)
        ImageDraw.Draw(picture).text((float(u), float(v)), text, fill=int(random.choice([0, 230, 255])))
    if in_print:
        picture = printed(random, picture)
    if chance(random, 0.5):
        picture = compressed(picture, int(between(random, 30.0, 96.0)))
    return np.asarray(picture, dtype=np.uint8)
