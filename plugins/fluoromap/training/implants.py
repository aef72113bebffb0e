"""Metal that stays in the body: coils, clips, steel wires, valve rings, pacemakers. It carries no labels."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from fluoromap.contracts import Array
from fluoromap.training.courses import square
from fluoromap.training.drawing import Canvas
from fluoromap.training.randomness import between, chance, random_curve, scaled


def draw_coil(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a spring, a braid or a part of a coil: a dense zigzag along a line."""
    curve = random_curve(random, between(random, 15.0, 60.0), 0.25, between(random, 0.0, 1.5), tilt=0.0)
    anchor = curve.points_mm[int(random.integers(len(curve.points_mm)))]
    line = (curve.points_mm - anchor) * px_per_mm + random.uniform(0.0, canvas.size, 2)
    draw_zigzag(random, canvas, px_per_mm, line, curve.heading, between(random, 0.4, 1.6) * px_per_mm)


def draw_zigzag(
    random: Generator, canvas: Canvas, px_per_mm: float, line: Array, heading: Array, swing: float
) -> None:  # fmt: skip
    """Draw a coil along points that are 0.25 mm apart."""
    phase = 2.0 * math.pi * np.arange(len(line)) * 0.25 / scaled(random, 0.5, 4.0)
    canvas.stroke(line + square(heading) * (swing * np.sin(phase))[:, None], between(random, 0.1, 0.35) * px_per_mm,
                  scaled(random, 0.1, 0.9))  # fmt: skip
    if chance(random, 0.6):
        canvas.stroke(line, swing, scaled(random, 0.1, 0.9))


def draw_clip(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw surgical clips and staples.

    They are short dense strokes, alone, as a V or in a row.
    """
    at, angle = random.uniform(0.0, canvas.size, 2), between(random, 0.0, 6.3)
    length, radius, dark = (
        between(random, 1.5, 7.0) * px_per_mm,
        scaled(random, 0.15, 0.6) * px_per_mm,
        scaled(random, 0.2, 1.6),
    )
    spread = between(random, 0.05, 0.8)
    step = random.normal(size=2) * 6.0 * px_per_mm
    for number in range(1 if chance(random, 0.6) else int(random.integers(2, 6))):
        place = at + number * step + random.normal(size=2) * 1.5 * px_per_mm
        ends = [
            place + length * np.array([math.cos(angle + side), math.sin(angle + side)]) for side in (-spread, spread)
        ]
        canvas.stroke(np.array([ends[0], place, ends[1]] if chance(random, 0.5) else [place, ends[0]]), radius, dark)


def draw_blob(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw one dense thing of electrode size without a catheter.

    It is calcium, a bead, a screw's head or a marker.
    """
    at = random.uniform(0.0, canvas.size, 2)
    canvas.disc(at, scaled(random, 0.4, 2.5) * px_per_mm, scaled(random, 0.4, 2.0) * px_per_mm, between(random, 0.0, 6.3),
                scaled(random, 0.1, 1.3), between(random, 0.6, 2.0), between(random, 2.0, 5.0))  # fmt: skip


def draw_sternal_wire(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw loops of steel wire with a twisted knot."""
    at = random.uniform(0.0, canvas.size, 2)
    radius, dark = between(random, 0.25, 0.55) * px_per_mm, scaled(random, 0.3, 1.5)
    for number in range(int(random.integers(1, 4))):
        angle = np.linspace(0.0, between(random, 4.0, 7.5), 40) + between(random, 0.0, 6.3)
        wide, high = between(random, 2.0, 10.0) * px_per_mm, between(random, 1.0, 9.0) * px_per_mm
        loop = (
            at
            + np.array([random.normal() * 2.0, number * 14.0 * px_per_mm])
            + np.stack([wide * np.cos(angle), high * np.sin(angle)], axis=1)
        )
        canvas.stroke(loop, radius, dark)
        if chance(random, 0.7):
            canvas.stroke(np.array([loop[0], loop[0] + random.normal(size=2) * 3.0 * px_per_mm]), 1.8 * radius, dark)


def draw_valve_ring(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a valve's ring or a stent.

    It is an ellipse of wire, perhaps with struts or a row of cells.
    """
    at, turn = random.uniform(0.0, canvas.size, 2), between(random, 0.0, 6.3)
    wide, high = between(random, 7.0, 16.0) * px_per_mm, between(random, 0.5, 12.0) * px_per_mm
    angle = np.linspace(0.0, 2.0 * math.pi, 72)
    axis, square = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    wave = np.ones_like(angle)
    if chance(random, 0.4):
        wave += between(random, 0.05, 0.35) * np.sin(angle * int(random.integers(6, 18)))
    ring = at + (wide * np.cos(angle) * wave)[:, None] * axis + (high * np.sin(angle) * wave)[:, None] * square
    dark = scaled(random, 0.15, 1.3)
    canvas.stroke(ring, scaled(random, 0.15, 1.0) * px_per_mm, dark)
    if chance(random, 0.4):
        for k in range(0, 72, int(random.integers(6, 24))):
            canvas.stroke(
                np.array([ring[k], ring[k] + axis * (between(random, 3.0, 12.0) * px_per_mm)]), 0.2 * px_per_mm, dark
            )


def draw_device(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a pacemaker's can with its parts, at the edge of the scene."""
    at = random.uniform(0.0, 1.0, 2) * canvas.size
    at[int(random.integers(2))] = float(random.choice([0.0, 1.0])) * canvas.size
    size = between(random, 10.0, 25.0) * px_per_mm
    dark = between(random, 0.3, 1.5)
    canvas.disc(at, size, size * between(random, 0.6, 1.0), between(random, 0.0, 6.3), dark, 1.0, 3.0)
    for _ in range(int(random.integers(0, 10))):
        place = at + random.normal(size=2) * 0.4 * size
        half_u, half_v = (scaled(random, 0.5, 5.0) * px_per_mm for _ in range(2))
        canvas.disc(place, half_u, half_v, between(random, 0.0, 6.3), between(random, -0.6, 0.6) * dark, 0.8, 5.0)
