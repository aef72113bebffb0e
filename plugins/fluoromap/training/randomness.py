"""Random numbers as scenes need them: uniform, log-uniform, chance; and smooth random curves and fields."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from fluoromap.contracts import Array
from fluoromap.training.drawing import Image


def between(random: Generator, low: float, high: float) -> float:
    """Draw uniformly."""
    return low + (high - low) * float(random.random())


def scaled(random: Generator, low: float, high: float) -> float:
    """Draw uniformly in the logarithm."""
    return float(low * (high / low) ** random.random())


def chance(random: Generator, probability: float) -> bool:
    """Return True with this probability."""
    return bool(random.random() < probability)


def whole(random: Generator, mean: float) -> int:
    """Draw one of the two whole numbers around ``mean``."""
    return int(mean) + int(chance(random, mean - int(mean)))


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A smooth curve in space seen along the rays.

    points_mm : (n, 2) its shadow at the isocentre. step_mm : arc length from point to point in space.
    heading : (n,) direction in the image, radians. shortening : (n,) length seen over length in space.
    """

    points_mm: Array
    step_mm: float
    heading: Array
    shortening: Array

    def at(self, arc_mm: Array) -> tuple[Array, Array, Array]:
        """Return places (k, 2) mm, headings (k,) and shortenings (k,) at these arc lengths."""
        own = np.arange(len(self.points_mm)) * self.step_mm
        places = np.stack([np.interp(arc_mm, own, self.points_mm[:, axis]) for axis in (0, 1)], axis=1)
        return places, np.interp(arc_mm, own, self.heading), np.interp(arc_mm, own, self.shortening)

    @classmethod
    def along(cls, heading: Array, shortening: Array, step_mm: float, start_mm: Array) -> Curve:
        """Return the curve of these directions from ``start_mm`` on."""
        points = np.empty((len(heading), 2))
        points[0] = start_mm
        seen = shortening[:-1] * step_mm
        points[1:, 0] = start_mm[0] + np.cumsum(np.cos(heading[:-1]) * seen)
        points[1:, 1] = start_mm[1] + np.cumsum(np.sin(heading[:-1]) * seen)
        return cls(points, step_mm, heading, shortening)

    def moved(self, by_mm: Array) -> Curve:
        """Return the curve moved by a vector."""
        return Curve(self.points_mm + by_mm, self.step_mm, self.heading, self.shortening)

    def backward(self) -> Curve:
        """Return the curve from its end to its beginning."""
        return Curve(self.points_mm[::-1], self.step_mm, self.heading[::-1] + math.pi, self.shortening[::-1])


def random_curve(
    random: Generator,
    length_mm: float,
    step_mm: float,
    bend: float,
    tilt: float | None = None,
    tilt_change: float = 0.3,
) -> Curve:
    """Draw a smooth curve.

    ``bend`` 0 is straight, 1 a catheter in a heart. ``tilt`` is its mean angle to the image plane.
    """
    count = max(4, int(length_mm / step_mm))
    arc = np.arange(count) * step_mm
    heading = np.full(count, between(random, 0.0, 2.0 * math.pi))
    for _ in range(2):
        wave = scaled(random, 25.0, 160.0)
        swing = bend * wave * between(random, 0.0, 0.017)
        heading += swing * np.sin(2.0 * math.pi * arc / wave + between(random, 0.0, 6.3))
    heading += arc * (bend * 0.012 * float(random.normal()))
    slope = between(random, 0.0, 1.25) if tilt is None else tilt
    slopes = slope + tilt_change * np.sin(2.0 * math.pi * arc / scaled(random, 30.0, 150.0) + between(random, 0.0, 6.3))
    return Curve.along(heading, np.maximum(np.abs(np.cos(slopes)), 0.24), step_mm, np.zeros(2))


def loop_curve(random: Generator, radius_mm: float, turns: float, shaft_mm: float, step_mm: float) -> Curve:
    """Draw a circle in space, and the shaft that leaves it.

    The circle begins at its free end. The shaft is about square to its plane.
    """
    arc = np.arange(0.0, 2.0 * math.pi * radius_mm * turns, step_mm)
    angle = arc / radius_mm
    circle = np.stack([-np.sin(angle), np.cos(angle), np.full(len(arc), 0.05)], axis=1)
    after = np.arange(step_mm, shaft_mm, step_mm)
    share = np.minimum(after / 8.0, 1.0)[:, None]
    straight = np.array([[0.0, 0.2, 1.0]]) + between(random, 0.0, 0.6) * np.stack(
        [np.sin(after / 30.0), np.cos(after / 45.0), np.zeros(len(after))], axis=1
    )
    shaft = (1.0 - share) * circle[-1] + share * straight
    directions = np.concatenate([circle, shaft])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = directions @ _rotation(random).T
    heading = np.unwrap(np.arctan2(turned[:, 1], turned[:, 0]))
    return Curve.along(heading, np.maximum(np.hypot(turned[:, 0], turned[:, 1]), 0.15), step_mm, np.zeros(2))


def _rotation(random: Generator) -> Array:
    """Draw a random rotation of space.

    A plane of a circle seen nearly edge-on is rare.
    """
    axes, _ = np.linalg.qr(random.normal(size=(3, 3)) + 0.8 * np.eye(3))
    return np.asarray(axes)


def smooth_field(random: Generator, size: int, grain_px: float) -> Image:
    """Draw a random field of standard deviation about 1, (size, size).

    Its detail is as large as ``grain_px``.
    """
    weights = _spline(size, max(4, int(size / grain_px) + 4))
    small = random.standard_normal((weights.shape[1], weights.shape[1]), dtype=np.float32)
    return np.asarray(1.5 * (weights @ small @ weights.T), dtype=np.float32)


@functools.lru_cache(maxsize=256)
def _spline(size: int, knots: int) -> Image:
    """Return a uniform cubic B-spline's weights at each pixel, (size, knots)."""
    place = np.linspace(1.0, knots - 2.001, size)[:, None] - np.arange(knots)
    away = np.abs(place)
    near = 2.0 / 3.0 - away**2 + 0.5 * away**3
    far = (2.0 - away) ** 3 / 6.0
    return np.where(away < 1.0, near, np.where(away < 2.0, far, 0.0)).astype(np.float32)
