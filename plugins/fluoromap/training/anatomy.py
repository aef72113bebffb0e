"""What lies behind the catheters: shading, lungs, heart, ribs, spine and diaphragm; or a lab's own electrode-free frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.random import Generator
from PIL import Image as PillowImage
from scipy.ndimage import affine_transform

from fluoromap.contracts import Array
from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.training.drawing import Canvas, Image
from fluoromap.training.randomness import between, chance, random_curve, scaled, smooth_field

_DARKEST = 0.04
_NOBODY = 0.15


def anatomy(random: Generator, size: int, px_per_mm: float, frontal: bool) -> Image:
    """Draw a body in attenuation, (size, size) log units, at a random contrast.

    A ``frontal`` view always has bones, mostly ribs and the spine. Some other scenes show a phantom on the table, without a
    body.
    """
    if not frontal and chance(random, _NOBODY):
        return (scaled(random, 0.002, 0.05) * smooth_field(random, size, between(random, 3.5, 60.0))).astype(np.float32)
    body = between(random, 0.0, 0.45) * smooth_field(random, size, between(random, 35.0, 110.0))
    body += between(random, 0.0, 0.12) * smooth_field(random, size, between(random, 9.0, 28.0))
    body += scaled(random, 0.002, 0.05) * smooth_field(random, size, between(random, 3.5, 9.0))
    body += scaled(random, 0.002, 0.035) * smooth_field(random, size, between(random, 1.8, 3.5))
    if frontal or chance(random, 0.6):
        bones = Canvas.empty(size)
        if chance(random, 0.8 if frontal else 0.45):
            _draw_ribs(random, bones, px_per_mm)
        if chance(random, 0.75 if frontal else 0.35):
            _draw_spine(random, bones, px_per_mm)
        if chance(random, 0.5):
            _draw_borders(random, bones, px_per_mm)
        if chance(random, 0.35):
            _draw_lung_vessels(random, bones, px_per_mm)
        body += gaussian(bones.depth, between(random, 0.6, 2.5)) * scaled(random, 0.4, 1.6)
    return body.astype(np.float32)


def _draw_ribs(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    for _ in range(int(random.integers(1, 6))):
        curve = random_curve(
            random, between(random, 0.8, 2.0) * canvas.size / px_per_mm, 2.0, 0.6, tilt=0.0, tilt_change=0.1
        )
        line = curve.points_mm * px_per_mm
        line += random.uniform(0.0, canvas.size, 2) - line[len(line) // 2]
        half, dark = between(random, 3.0, 8.0) * px_per_mm, between(random, 0.03, 0.22)
        canvas.stroke(line, half, dark, flat=True)
        canvas.stroke(line, half * between(random, 0.75, 0.93), -dark * between(random, 0.2, 0.7), flat=True)


def _draw_spine(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw bodies, discs, end plates and pedicles.

    A pedicle's ring is of electrode size.
    """
    angle = between(random, -0.3, 0.3) + (0.5 * math.pi if chance(random, 0.8) else between(random, 0.0, math.pi))
    axis, square = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    middle = random.uniform(0.0, canvas.size, 2)
    half, pitch = between(random, 12.0, 20.0) * px_per_mm, between(random, 24.0, 34.0) * px_per_mm
    dark = between(random, 0.1, 0.45)
    reach = 1.5 * canvas.size
    along = np.arange(-reach, reach, pitch / 8.0)
    waist = 1.0 - between(random, 0.0, 0.12) * np.sin(math.pi * along / pitch) ** 2
    canvas.stroke(middle + along[:, None] * axis, half * waist, dark, flat=True)
    if chance(random, 0.5):
        _draw_aorta(random, canvas, px_per_mm, middle + along[:, None] * axis, square * half)
    for number in range(-math.ceil(reach / pitch), math.ceil(reach / pitch) + 1):
        at = middle + axis * (number * pitch)
        plate = np.array([at - square * half, at + square * half])
        canvas.stroke(plate, between(random, 1.0, 2.5) * px_per_mm, -dark * between(random, 0.1, 0.5))
        for side in (-1.0, 1.0):
            place = at + axis * (0.35 * pitch) + square * (side * 0.65 * half)
            wide = between(random, 2.0, 4.0) * px_per_mm
            canvas.disc(place, 1.4 * wide, wide, angle, dark * between(random, 0.1, 0.5), 1.5, 2.0)
            canvas.disc(place, 0.9 * wide, 0.6 * wide, angle, -dark * between(random, 0.0, 0.3), 1.5, 2.0)


def _draw_aorta(random: Generator, canvas: Canvas, px_per_mm: float, line: Array, edge: Array) -> None:
    """Draw the descending aorta: its border runs beside the spine's and crosses it."""
    half, side = between(random, 9.0, 14.0) * px_per_mm, float(random.choice([-1.0, 1.0]))
    wave = np.sin(np.arange(len(line)) / between(random, 5.0, 20.0) + between(random, 0.0, 6.3))
    away = between(random, 0.3, 1.1) + between(random, 0.0, 0.3) * wave
    canvas.stroke(line + side * away[:, None] * edge, half, between(random, 0.03, 0.2), flat=True)


def _draw_borders(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw heart, diaphragm and vertebral line.

    Each darkens half the scene behind a smooth border.
    """
    at, angle = random.uniform(0.0, canvas.size, 2), between(random, 0.0, 6.3)
    size = between(random, 25.0, 90.0) * px_per_mm
    canvas.disc(at + size * np.array([math.cos(angle), math.sin(angle)]), size, size * between(random, 0.6, 1.3), angle,
                between(random, 0.05, 0.6), between(random, 0.5, 6.0) * px_per_mm, 2.0)  # fmt: skip


def _draw_lung_vessels(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    start = random.uniform(0.0, canvas.size, 2)
    for _ in range(int(random.integers(4, 20))):
        curve = random_curve(random, between(random, 15.0, 60.0), 1.0, 1.5, tilt=0.0)
        line = curve.points_mm * px_per_mm + start + random.normal(size=2) * 10.0 * px_per_mm
        taper = np.linspace(1.0, 0.3, len(line))
        canvas.stroke(line, between(random, 0.5, 2.0) * px_per_mm * taper, between(random, 0.01, 0.12) * taper)


def read_backgrounds(folder: Path) -> tuple[Image, ...]:
    """Read a lab's own frames without catheters.

    The files are PNG, TIFF or JPEG of 8 or 16 bit, dark where X-rays are absorbed.

    Returns
    -------
    tuple of (rows, columns) float32 images of attenuation, log units.

    Raises
    ------
    FileNotFoundError
        When the folder has no such file.
    """
    files = sorted(
        path for path in folder.iterdir() if path.suffix.lower() in {".png", ".tif", ".tiff", ".jpg", ".jpeg"}
    )
    if not files:
        raise FileNotFoundError(f"{folder} has no PNG, TIFF or JPEG file: put electrode-free frames there")
    return tuple(_attenuation(np.asarray(PillowImage.open(path))) for path in files)


def _attenuation(pixels: Image) -> Image:
    grey = pixels.mean(axis=2) if pixels.ndim == 3 else pixels.astype(np.float32)
    brightest = max(float(np.percentile(grey, 99.8)), 1.0)
    return np.asarray(-np.log(_DARKEST + np.minimum(grey / brightest, 1.0)), dtype=np.float32)


def from_backgrounds(random: Generator, size: int, frames: Sequence[Image]) -> Image:
    """Cut a piece out of a lab's frame, (size, size) log units.

    The piece is turned, mirrored and scaled, at a random contrast.
    """
    frame = frames[int(random.integers(len(frames)))]
    angle, scale = between(random, 0.0, 2.0 * math.pi), scaled(random, 0.65, 1.6)
    turn = scale * np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    if chance(random, 0.5):
        turn[:, 0] *= -1.0
    middle = np.array([between(random, 0.2, 0.8) * length for length in frame.shape])
    offset = middle - turn @ np.full(2, 0.5 * (size - 1))
    cut = affine_transform(frame, turn, offset, (size, size), order=1, mode="mirror")
    piece: Image = (cut * scaled(random, 0.3, 1.3)).astype(np.float32)
    return gaussian(piece, between(random, 0.5, 2.0)) if chance(random, 0.35) else piece
