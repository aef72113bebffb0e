"""Leads of pacemakers and defibrillators, with the places of their electrodes as labels."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from fluoromap.contracts import Array
from fluoromap.training.courses import entering
from fluoromap.training.drawing import Canvas
from fluoromap.training.drawn_catheters import LABEL_COLUMNS
from fluoromap.training.implants import draw_zigzag
from fluoromap.training.randomness import between, chance, random_curve, scaled

_STEP_MM = 0.25


def draw_lead(random: Generator, canvas: Canvas, px_per_mm: float) -> Array:
    """Draw a lead from its tip to the border.

    It has a tip, mostly a ring and a screw, perhaps one or two shock coils, and a conductor that shows all along.

    Returns
    -------
    (electrodes, LABEL_COLUMNS) the tip, and the ring where there is one.
    """
    curve = random_curve(random, between(random, 80.0, 160.0), _STEP_MM, between(random, 0.3, 1.6), tilt_change=0.3)
    curve = entering(random, canvas.size / px_per_mm, curve, 60.0)
    line, heading = curve.points_mm * px_per_mm, curve.heading
    radius, dark = between(random, 0.6, 1.3) * px_per_mm, scaled(random, 0.2, 1.4)
    canvas.stroke(line, radius, dark * between(random, 0.1, 0.6), 0.0 if chance(random, 0.5) else 0.6)
    if chance(random, 0.5):
        screw = np.array([math.cos(heading[0]), math.sin(heading[0])]) * between(random, 1.0, 2.5) * px_per_mm
        canvas.stroke(np.array([line[0], line[0] - screw]), 0.25 * px_per_mm, dark)
    half_mm = between(random, 0.5, 1.5)
    electrodes = [(half_mm, half_mm)]
    if chance(random, 0.8):
        electrodes.append((between(random, 7.0, 14.0), between(random, 0.7, 2.0)))
    labels = np.zeros((len(electrodes), LABEL_COLUMNS))
    for number, (arc_mm, half_mm) in enumerate(electrodes):
        k = int(arc_mm / _STEP_MM)
        way, half = float(heading[k]), half_mm * px_per_mm * float(curve.shortening[k])
        canvas.band(line[k], way + math.pi, half, radius, dark, 0.0, number == 0, 0.7)
        labels[number] = line[k, 0], line[k, 1], float(number == 0), dark, half, radius
    from_mm = between(random, 12.0, 20.0)
    for _ in range(int(random.choice([0, 0, 1, 1, 2]))):
        first, last = int(from_mm / _STEP_MM), int((from_mm + between(random, 40.0, 65.0)) / _STEP_MM)
        if last < len(line):
            draw_zigzag(random, canvas, px_per_mm, line[first:last], heading[first:last], 1.1 * radius)
        from_mm += between(random, 90.0, 150.0)
    return labels
