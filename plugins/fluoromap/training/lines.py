"""Cables, wires, sheaths and catheters without electrodes. They carry no labels."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from fluoromap.training.courses import entering, line_across, square
from fluoromap.training.drawing import Canvas
from fluoromap.training.randomness import between, chance, random_curve, scaled


def draw_cable(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw an ECG cable or another line from border to border."""
    points, _ = line_across(random, canvas.size / px_per_mm, between(random, 0.0, 1.2), ends=0.15)
    line = points * px_per_mm
    hollow = between(random, 0.3, 0.8) if chance(random, 0.3) else 0.0
    radius = scaled(random, 0.15, 2.3) * px_per_mm
    canvas.stroke(line, radius, scaled(random, 0.05, 0.9), hollow)
    if chance(random, 0.3):
        canvas.stroke(line, 0.4 * radius, scaled(random, 0.05, 0.6))


def draw_parallel_cables(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw ECG cables side by side that spread slowly."""
    points, heading = line_across(random, canvas.size / px_per_mm, between(random, 0.0, 0.8))
    radius, dark = between(random, 0.4, 1.3) * px_per_mm, scaled(random, 0.1, 0.7)
    across = square(heading)
    arc = np.linspace(-1.0, 1.0, len(points))
    for _ in range(int(random.integers(2, 5))):
        apart = float(random.normal()) * 4.0 + float(random.normal()) * 5.0 * arc
        canvas.stroke((points + across * apart[:, None]) * px_per_mm, radius, dark * between(random, 0.8, 1.2))


def draw_ecg_electrode(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a cable that ends in a snap: a ring, a plug, a rod."""
    points, heading = line_across(random, canvas.size / px_per_mm, between(random, 0.0, 1.0), ends=1.0)
    line = points * px_per_mm
    canvas.stroke(line, scaled(random, 0.3, 1.3) * px_per_mm, scaled(random, 0.1, 0.7))
    at, wide = line[0], between(random, 1.5, 6.0) * px_per_mm
    dark = scaled(random, 0.1, 0.9)
    canvas.disc(at, wide, wide * between(random, 0.7, 1.0), 0.0, dark, 1.0, 2.0)
    if chance(random, 0.7):
        inner = wide * between(random, 0.3, 0.75)
        canvas.disc(at, inner, inner * between(random, 0.7, 1.0), 0.0, -dark * between(random, 0.3, 1.0), 1.0, 2.0)
    if chance(random, 0.6):
        angle = float(heading[0]) + random.normal() * 0.5
        toward = np.array([math.cos(angle), math.sin(angle)])
        half = between(random, 2.0, 6.0) * px_per_mm
        canvas.band(
            at - toward * (wide + half),
            angle,
            half,
            between(random, 0.6, 1.8) * px_per_mm,
            scaled(random, 0.2, 1.0),
            0.0,
            False,
            0.7,
        )
        if chance(random, 0.5):
            canvas.band(at - toward * (wide + 2.1 * half), angle, between(random, 0.8, 2.0) * px_per_mm,
                        between(random, 0.8, 2.2) * px_per_mm, scaled(random, 0.2, 1.0), 0.0, False, 0.7)  # fmt: skip


def draw_guide_wire(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a thin wire, often curled, sometimes with a denser end."""
    points, _ = line_across(random, canvas.size / px_per_mm, between(random, 0.5, 3.5), ends=0.7)
    line = points * px_per_mm
    canvas.stroke(line, scaled(random, 0.1, 0.45) * px_per_mm, scaled(random, 0.1, 1.0))
    if chance(random, 0.5):
        end = line[: int(random.integers(4, max(6, len(line) // 2)))]
        canvas.stroke(end, between(random, 0.15, 0.45) * px_per_mm, scaled(random, 0.2, 1.2))


def draw_sheath(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a hollow tube without electrodes, perhaps with one marker band."""
    points, heading = line_across(random, canvas.size / px_per_mm, between(random, 0.0, 1.5), ends=0.7)
    line = points * px_per_mm
    wide = between(random, 0.8, 2.2) * px_per_mm
    canvas.stroke(line, wide, scaled(random, 0.05, 0.5), between(random, 0.5, 0.88))
    if chance(random, 0.5):
        k = 0 if chance(random, 0.5) else int(random.integers(len(line)))
        canvas.band(
            line[k],
            float(heading[k]),
            between(random, 0.3, 0.9) * px_per_mm,
            wide,
            scaled(random, 0.1, 0.9),
            0.8,
            False,
            0.7,
        )


def draw_plain_catheter(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw an angiography catheter or a Swan-Ganz catheter.

    It is a shaft that ends without electrodes, hooked or curled.
    """
    curve = random_curve(random, between(random, 40.0, 120.0), 0.5, between(random, 0.8, 4.0), tilt_change=0.3)
    curve = entering(random, canvas.size / px_per_mm, curve, 40.0)
    line = curve.points_mm * px_per_mm
    canvas.stroke(
        line,
        between(random, 0.6, 1.3) * px_per_mm,
        scaled(random, 0.1, 0.9),
        0.0 if chance(random, 0.4) else between(random, 0.4, 0.8),
    )
    if chance(random, 0.3):
        canvas.band(line[0], float(curve.heading[0]), between(random, 0.3, 1.5) * px_per_mm, between(random, 0.6, 1.3) * px_per_mm,
                    scaled(random, 0.1, 1.0), 0.0, True, 0.7)  # fmt: skip
