"""Courses of long things through a scene: they enter it or cross it, and never stop in it without a reason."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from fluoromap.contracts import Array
from fluoromap.training.randomness import Curve, between, chance, random_curve

_STRAIGHTENS_MM = 15.0
_SHARPEST_PER_MM = 0.03
_FLATTENS_TO = 0.7


def to_border(curve: Curve, scene_mm: float) -> Curve:
    """Continue a curve from its last point to the scene's border.

    The scene's corner is (0, 0). The curve goes on with its last bend, which fades, so that it cannot turn back.
    """
    end = curve.points_mm[-1]
    if not ((end > -2.0) & (end < scene_mm + 2.0)).all():
        return curve
    bend = float(curve.heading[-1] - curve.heading[-2]) / curve.step_mm
    bend = min(max(bend, -_SHARPEST_PER_MM), _SHARPEST_PER_MM)
    arc = np.arange(curve.step_mm, 1.6 * scene_mm / _FLATTENS_TO + _STRAIGHTENS_MM, curve.step_mm)
    fading = np.exp(-arc / _STRAIGHTENS_MM)
    heading = curve.heading[-1] + bend * _STRAIGHTENS_MM * (1.0 - fading)
    last = float(curve.shortening[-1])
    flat = max(last, _FLATTENS_TO)
    return Curve.along(
        np.concatenate([curve.heading, heading]),
        np.concatenate([curve.shortening, flat + (last - flat) * fading]),
        curve.step_mm,
        curve.points_mm[0],
    )


def entering(random: Generator, scene_mm: float, curve: Curve, within_mm: float) -> Curve:
    """Place a curve in the scene and continue it to the border.

    A point of its first ``within_mm`` lies in the scene.
    """
    anchor = int(between(random, 0.0, min(within_mm / curve.step_mm, len(curve.points_mm) - 1.0)))
    origin = random.uniform(0.0, scene_mm, 2) - curve.points_mm[anchor]
    return to_border(curve.moved(origin), scene_mm)


def crossing(random: Generator, scene_mm: float, bend: float, step_mm: float) -> Curve:
    """Draw a curve that crosses the scene, about in the image plane."""
    length = between(random, 0.6, 2.2) * scene_mm
    curve = random_curve(random, length, step_mm, bend, tilt=0.0, tilt_change=between(random, 0.0, 0.5))
    return to_border(entering(random, scene_mm, curve, length).backward(), scene_mm)


def line_across(
    random: Generator, scene_mm: float, bend: float, step_mm: float = 1.0, ends: float = 0.0
) -> tuple[Array, Array]:
    """Draw points (mm) and headings of a line across the scene.

    With the chance ``ends`` it begins in the scene.
    """
    if chance(random, ends):
        length = between(random, 0.6, 2.2) * scene_mm
        curve = random_curve(random, length, step_mm, bend, tilt=0.0, tilt_change=between(random, 0.0, 0.5))
        curve = entering(random, scene_mm, curve, 0.5 * length)
    else:
        curve = crossing(random, scene_mm, bend, step_mm)
    return curve.points_mm, curve.heading


def square(heading: Array) -> Array:
    """Return the unit vectors at right angles to headings, (n, 2)."""
    return np.stack([-np.sin(heading), np.cos(heading)], axis=1)


def beside(random: Generator, curve: Curve, from_mm: float) -> Curve:
    """Draw a curve beside another one.

    It begins ``from_mm`` behind the beginning of that one, and slowly leaves it.
    """
    first = int(from_mm / curve.step_mm)
    heading = curve.heading[first:]
    arc = np.arange(len(heading)) * curve.step_mm
    away = between(random, 0.0, 0.3) * np.sin(2.0 * math.pi * (arc / between(random, 40.0, 160.0) + random.random()))
    offset = square(heading[:1])[0] * between(random, -4.0, 4.0)
    return Curve.along(heading + away, curve.shortening[first:], curve.step_mm, curve.points_mm[first] + offset)
