"""Probes in the oesophagus: echo probes, endoscopes, temperature probes. They carry no labels."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from fluoromap.contracts import Array
from fluoromap.training.courses import line_across, to_border
from fluoromap.training.drawing import Canvas
from fluoromap.training.randomness import Curve, between, chance, random_curve, scaled


def draw_echo_probe(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a transoesophageal echo probe.

    It is a box with parts inside, and a thick shaft of many segments.
    """
    at = random.uniform(-0.1, 1.1, 2) * canvas.size
    angle = between(random, 0.0, 6.3)
    half = between(random, 4.0, 7.0) * px_per_mm
    length = between(random, 12.0, 30.0) * px_per_mm
    axis, square = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    dark = between(random, 0.25, 1.0)
    canvas.disc(at, length, half, angle, dark, 1.0, 6.0)
    canvas.disc(at, 0.92 * length, 0.85 * half, angle, -dark * between(random, 0.0, 0.6), 1.0, 6.0)
    for _ in range(int(random.integers(2, 12))):
        inside = at + axis * (between(random, -0.85, 0.85) * length) + square * (between(random, -0.7, 0.7) * half)
        canvas.disc(inside, scaled(random, 0.4, 5.0) * px_per_mm, scaled(random, 0.4, 3.0) * px_per_mm, angle,
                    between(random, -0.3, 1.1), 0.8, 6.0)  # fmt: skip
    _segments(random, canvas, px_per_mm, at - axis * length, angle + math.pi, between(random, 0.6, 1.0) * half)


def draw_segmented_shaft(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw the shaft of an echo probe or an endoscope without its head."""
    _segments(random, canvas, px_per_mm, random.uniform(-0.1, 1.1, 2) * canvas.size, between(random, 0.0, 6.3),
              between(random, 2.0, 5.5) * px_per_mm)  # fmt: skip


def _segments(random: Generator, canvas: Canvas, px_per_mm: float, start: Array, angle: float, half: float) -> None:
    drawn = random_curve(random, between(random, 40.0, 120.0), 0.5, between(random, 0.2, 1.5), tilt=0.0)
    turned = drawn.heading + (angle - float(drawn.heading[0]))
    curve = Curve.along(turned, drawn.shortening, drawn.step_mm, start / px_per_mm)
    curve = to_border(curve, canvas.size / px_per_mm)
    line = curve.points_mm * px_per_mm
    canvas.stroke(line, half, between(random, 0.1, 0.6), between(random, 0.5, 0.9))
    pitch = between(random, 2.0, 7.0)
    long, dark, wide = pitch * between(random, 0.15, 0.6), scaled(random, 0.08, 0.9), half * between(random, 0.5, 1.0)
    hollow = 0.0 if chance(random, 0.6) else between(random, 0.6, 0.9)
    for arc in np.arange(0.0, 0.5 * (len(line) - 1), pitch):
        k = int(2.0 * arc)
        canvas.band(
            line[k],
            float(curve.heading[k]),
            0.5 * long * px_per_mm,
            wide,
            dark * between(random, 0.8, 1.2),
            hollow,
            False,
            0.8,
        )


def draw_temperature_probe(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw an oesophageal temperature probe.

    It is a soft shaft with one to five olives wider than itself, or a metal cap at its end.
    """
    line, heading = _soft_shaft(random, canvas, px_per_mm)
    radius = between(random, 1.0, 2.5) * px_per_mm
    canvas.stroke(line, radius, scaled(random, 0.04, 0.4), between(random, 0.0, 0.8))
    canvas.stroke(line, 0.15 * px_per_mm, scaled(random, 0.05, 0.5))
    pitch = int(2 * between(random, 8.0, 20.0))
    for k in range(0, min(len(line), pitch * int(random.integers(1, 6))), pitch):
        canvas.disc(line[k], between(random, 1.5, 4.0) * px_per_mm, radius * between(random, 1.1, 1.6), float(heading[k]),
                    scaled(random, 0.2, 1.2), 1.0, between(random, 2.0, 3.0))  # fmt: skip


def draw_sensor_row(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a temperature probe with a row of small sensors in a wide shaft.

    Unlike electrodes they are narrower than the shaft, lie 7 to 20 mm apart, and leads run between them.
    """
    line, heading = _soft_shaft(random, canvas, px_per_mm)
    radius = between(random, 1.2, 2.2) * px_per_mm
    canvas.stroke(line, radius, scaled(random, 0.04, 0.3), between(random, 0.0, 0.8))
    canvas.stroke(line, between(random, 0.12, 0.3) * px_per_mm, scaled(random, 0.1, 0.6))
    pitch, first = int(2 * between(random, 7.0, 20.0)), int(random.integers(2, 12))
    half, wide, dark = (
        between(random, 0.5, 1.6) * px_per_mm,
        radius * between(random, 0.2, 0.6),
        scaled(random, 0.2, 1.2),
    )
    for k in range(first, min(len(line), first + pitch * int(random.integers(3, 13))), pitch):
        canvas.disc(line[k], half, wide, float(heading[k]), dark, 0.8, between(random, 2.0, 5.0))


def _soft_shaft(random: Generator, canvas: Canvas, px_per_mm: float) -> tuple[Array, Array]:
    """Draw points (pixels, 0.5 mm apart) and headings of a probe's shaft from its end on."""
    points, heading = line_across(random, canvas.size / px_per_mm, between(random, 0.2, 1.2), 0.5, ends=1.0)
    return points * px_per_mm, heading
