"""Contrast medium in vessels and tubes: full, beaded, drained, or left in crumbs. It carries no labels."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from fluoromap.contracts import Array
from fluoromap.training.courses import line_across, square
from fluoromap.training.drawing import Canvas
from fluoromap.training.randomness import Curve, between, chance, random_curve, scaled


def draw_vessels(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw vessels filled with contrast medium.

    In places they are beaded, interrupted, or mixed with blood.
    """
    _branch(
        random, canvas, px_per_mm, random.uniform(0.0, canvas.size, 2), between(random, 0.0, 6.3), between(random, 0.5, 2.4),
        scaled(random, 0.08, 1.4), int(random.integers(1, 4)),
    )  # fmt: skip


def _branch(
    random: Generator,
    canvas: Canvas,
    px_per_mm: float,
    start: Array,
    angle: float,
    radius_mm: float,
    dark: float,
    left: int,
) -> None:
    curve = random_curve(random, between(random, 12.0, 45.0), 0.5, between(random, 0.3, 2.5), tilt=0.0)
    turn = angle - float(curve.heading[0])
    cosine, sine = math.cos(turn), math.sin(turn)
    line = curve.points_mm @ np.array([[cosine, sine], [-sine, cosine]]) * px_per_mm + start
    taper = np.linspace(1.0, between(random, 0.5, 1.0), len(line))
    radius, strength = radius_mm * px_per_mm * taper, dark * taper
    if chance(random, 0.45):
        strength = strength * _beads(random, len(line))
        if chance(random, 0.5):
            radius = radius * (1.0 + 0.35 * (_beads(random, len(line)) - 0.5))
    canvas.stroke(line, radius, strength)
    if left > 0:
        for _ in range(int(random.integers(1, 4))):
            k = int(random.integers(len(line) // 3, len(line)))
            _branch(random, canvas, px_per_mm, line[k], float(curve.heading[k]) + turn + random.normal() * 0.8,
                    radius_mm * between(random, 0.45, 0.85), dark * between(random, 0.6, 1.0), left - 1)  # fmt: skip


def _beads(random: Generator, count: int) -> Array:
    """Draw shares from 0 to 1 along a line.

    They swell and fade with an irregular period of 2 to 10 mm.
    """
    pace = 2.0 * math.pi * 0.5 / scaled(random, 2.0, 10.0)
    phase = np.cumsum(pace * np.exp(0.5 * np.convolve(random.normal(size=count + 8), np.ones(9) / 3.0, "valid")))
    wave = 0.5 + 0.5 * np.sin(phase + between(random, 0.0, 6.3))
    sharp = between(random, 0.5, 3.0)
    depth = between(random, 0.3, 1.0)
    faded: Array = 1.0 - depth * np.clip(0.5 + sharp * (wave - 0.5), 0.0, 1.0)
    return faded


def draw_drained_tube(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a vessel or tube that the contrast medium has left.

    Plugs and rims remain, which lie in a row like electrodes.
    """
    curve = random_curve(random, between(random, 15.0, 70.0), 0.5, between(random, 0.2, 2.0), tilt=0.0)
    line = _placed(random, canvas, curve, px_per_mm)
    radius, dark = between(random, 0.7, 2.2) * px_per_mm, scaled(random, 0.1, 1.5)
    if chance(random, 0.35):
        canvas.stroke(line, radius, dark * _fillings(random, len(line)))
        return
    canvas.stroke(
        line, radius, dark * between(random, 0.05, 0.5), 0.0 if chance(random, 0.6) else between(random, 0.5, 0.9)
    )
    for k in random.integers(0, len(line), int(random.integers(1, 8))).tolist():
        half = radius * scaled(random, 0.4, 3.0)
        place = line[k] + random.normal(size=2) * 0.2 * radius
        wide, plug = radius * between(random, 0.4, 1.05), dark * between(random, 0.2, 1.0)
        canvas.disc(
            place,
            half,
            wide,
            float(curve.heading[k]),
            plug,
            between(random, 0.6, 2.5),
            between(random, 2.0, 4.0),
        )


def draw_tubing(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw joined tubes of a vessel phantom: each is partly filled.

    Elsewhere drops hang in it, which lie in a row like electrodes; where it is full it has bubbles.
    """
    joint = random.uniform(0.0, canvas.size, 2)
    radius, dark = between(random, 0.8, 3.0) * px_per_mm, scaled(random, 0.15, 1.5)
    for _ in range(int(random.integers(1, 4))):
        curve = random_curve(random, between(random, 25.0, 110.0), 0.5, between(random, 0.1, 1.2), tilt=0.0)
        line = (curve.points_mm - curve.points_mm[0]) * px_per_mm + joint
        if chance(random, 0.6):
            canvas.stroke(line, 1.2 * radius, scaled(random, 0.02, 0.2), between(random, 0.7, 0.93))
        ends = np.sort(random.integers(0, len(line), 2)) if chance(random, 0.8) else np.zeros(2, np.int64)
        filled = np.full(len(line), dark * (0.0 if chance(random, 0.3) else scaled(random, 0.03, 0.4)))
        filled[ends[0] : ends[1]] = dark
        canvas.stroke(line, radius, filled)
        k, apart = 0, scaled(random, 2.5, 15.0)
        while (k := k + max(int(apart * scaled(random, 0.4, 2.0) / curve.step_mm), 1)) < len(line):
            in_it = ends[0] <= k < ends[1]
            canvas.disc(
                line[k] + random.normal(size=2) * 0.2 * radius,
                scaled(random, 0.4, 2.5) * px_per_mm,
                radius * between(random, 0.3, 1.0),
                float(curve.heading[k]),
                dark * (-between(random, 0.0, 0.8) if in_it else scaled(random, 0.15, 1.0)),
                between(random, 0.6, 1.8),
                between(random, 2.0, 4.0),
            )


def _fillings(random: Generator, count: int) -> Array:
    """Draw shares from 0 to 1: plugs that end abruptly."""
    empty = between(random, 0.05, 0.4)
    lengths = np.exp(random.uniform(math.log(2.0), math.log(50.0), count // 2 + 1)).astype(np.int64)
    full = np.where(np.arange(len(lengths)) % 2 == 0, 1.0, empty) * random.uniform(0.8, 1.0, len(lengths))
    filled: Array = np.repeat(full, lengths)[:count]
    return filled


def draw_residue(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw contrast medium left in crumbs along a line or an edge."""
    points, heading = line_across(random, canvas.size / px_per_mm, between(random, 0.2, 2.0), ends=0.5)
    line = points * px_per_mm
    dark = scaled(random, 0.1, 1.5)
    wide = scaled(random, 0.3, 3.0) * px_per_mm
    for k in random.integers(0, len(line), int(random.integers(5, 40))).tolist():
        at = line[k] + square(heading[k : k + 1])[0] * (random.normal() * wide)
        size = scaled(random, 0.2, 1.2) * px_per_mm
        canvas.disc(
            at,
            size * scaled(random, 0.7, 2.0),
            size,
            float(heading[k]),
            dark * between(random, 0.3, 1.0),
            between(random, 0.8, 2.0),
            2.0,
        )


def _placed(random: Generator, canvas: Canvas, curve: Curve, px_per_mm: float) -> Array:
    """Put a random point of the curve somewhere in the scene; (n, 2) pixels."""
    anchor = curve.points_mm[int(random.integers(len(curve.points_mm)))]
    placed: Array = (curve.points_mm - anchor) * px_per_mm + random.uniform(0.0, canvas.size, 2)
    return placed
