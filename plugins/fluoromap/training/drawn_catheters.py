"""Catheters of all kinds drawn into a scene, with the place of each electrode as its label."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array
from fluoromap.training.drawing import Canvas
from fluoromap.training.randomness import Curve, between, chance, loop_curve, random_curve, scaled

LABEL_COLUMNS = 6
"""u, v (pixels), 1 for a tip, attenuation, half length seen and radius (pixels) of an electrode."""

_STEP_MM = 0.5
_DARKEST_SHAFT = 1.5
_FRENCH_RADII_MM = 0.67, 0.83, 1.0, 1.0, 1.0, 1.17, 1.17, 1.33


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """What a maker fixes: electrode centres from the tip's far end on and lengths, both along the shaft, mm."""

    centres_mm: Array
    lengths_mm: Array
    loop: bool = False


def design_of(catheter: Catheter) -> Design:
    """Return the design of a catalogue's catheter."""
    lengths = np.full(catheter.electrodes, catheter.ring_mm)
    lengths[0] = catheter.tip_mm
    return Design(catheter.arc_lengths_mm + 0.5 * catheter.tip_mm, lengths, catheter.is_circular)


def random_design(random: Generator, catalogue: Sequence[Catheter] = ()) -> Design:
    """Draw the design of a catheter.

    Half of the designs come from a lab's own ``catalogue`` where it has one; the others from all makers' kinds.
    """
    if catalogue and chance(random, 0.5):
        return design_of(catalogue[int(random.integers(len(catalogue)))])
    kind = random.random()
    ring = between(random, 0.9, 1.4) if chance(random, 0.6) else scaled(random, 0.8, 2.0)
    if kind < 0.30:
        electrodes, tip = (4 if chance(random, 0.85) else int(random.integers(2, 4))), between(random, 3.0, 8.5)
    elif kind < 0.54:
        electrodes, tip = 4, between(random, 1.0, 2.5)
    elif kind < 0.64:
        electrodes, tip = int(random.integers(5, 9)), between(random, 1.0, 2.5)
    elif kind < 0.86:
        electrodes, tip = 10, between(random, 1.0, 2.5)
    elif kind < 0.92:
        electrodes, tip = int(random.choice([12, 14, 16, 20])), between(random, 1.0, 2.2)
    elif kind < 0.97:
        electrodes, tip = int(random.integers(8, 21)), ring
        return _design(np.full(electrodes - 1, scaled(random, 1.5, 6.0)), ring, tip, loop=True)
    else:
        electrodes, tip = 2, between(random, 1.0, 3.0)
        return _design(np.array([between(random, 6.0, 12.0)]), scaled(random, 2.0, 4.0), tip)
    return _design(_gaps(random, electrodes - 1), ring, tip)


def _gaps(random: Generator, count: int) -> Array:
    """Draw the gaps between edges of neighbouring electrodes, mm."""
    pattern = random.random()
    if pattern < 0.5:
        pair, gap = (
            float(random.choice([1.0, 2.0, 2.0, 2.0, 2.5])),
            float(random.choice([4.0, 5.0, 5.0, 5.0, 6.0, 8.0])),
        )
        return np.where(np.arange(count) % 2 == 0, pair, gap)
    if pattern < 0.65:
        return np.full(count, between(random, 1.5, 2.5))
    if pattern < 0.82:
        return np.full(count, float(random.choice([4.0, 5.0, 5.0])))
    if pattern < 0.9:
        return np.full(count, scaled(random, 1.0, 9.0))
    return np.exp(random.uniform(math.log(0.8), math.log(9.0), count))


def _design(gaps_mm: Array, ring_mm: float, tip_mm: float, loop: bool = False) -> Design:
    lengths = np.full(len(gaps_mm) + 1, ring_mm)
    lengths[0] = tip_mm
    starts = np.concatenate([[0.0], np.cumsum(lengths[:-1] + gaps_mm)])
    return Design(starts + 0.5 * lengths, lengths, loop)


def draw_catheter(
    random: Generator, canvas: Canvas, px_per_mm: float, design: Design, metal_between: tuple[float, float]
) -> Array:
    """Draw one catheter somewhere in the scene, its electrodes of an attenuation in ``metal_between``.

    Returns
    -------
    (electrodes, LABEL_COLUMNS) one row an electrode, from the tip on.
    """
    curve = _course(random, design, canvas.size / px_per_mm)
    centres, headings, shortenings = curve.at(design.centres_mm)
    anchor = int(random.integers(len(centres)))
    origin = random.uniform(0.05, 0.95, 2) * canvas.size - centres[anchor] * px_per_mm
    line, places = curve.points_mm * px_per_mm + origin, centres * px_per_mm + origin
    radius = float(random.choice(_FRENCH_RADII_MM)) * px_per_mm
    metal = scaled(random, *metal_between)
    _draw_shaft(random, canvas, line, radius, metal, px_per_mm)
    labels = _draw_electrodes(random, canvas, design, places, headings, shortenings, radius, metal, px_per_mm)
    behind = float(design.centres_mm[-1]) + between(random, 3.0, 45.0)
    if chance(random, 0.2):
        _draw_sheath(random, canvas, line[int(behind / _STEP_MM) :], radius, px_per_mm)
    return labels


def _course(random: Generator, design: Design, scene_mm: float) -> Curve:
    length = float(design.centres_mm[-1])
    shaft = between(random, 0.6, 2.2) * scene_mm
    if design.loop:
        turns = between(random, 0.75, 1.05)
        return loop_curve(random, max(length / (2.0 * math.pi * turns), 5.0), turns, shaft, _STEP_MM)
    return random_curve(
        random, length + shaft, _STEP_MM, between(random, 0.3, 1.8), tilt_change=between(random, 0.0, 0.6)
    )


def _draw_shaft(random: Generator, canvas: Canvas, line: Array, radius: float, metal: float, px_per_mm: float) -> None:
    kind = random.random()
    if kind < 0.1:
        strength = 0.0
    elif kind < 0.82:
        strength = min(min(metal, _DARKEST_SHAFT) * between(random, 0.04, 0.7), 0.8)
    else:
        strength = between(random, 0.02, 0.3)
    if strength > 0:
        hollow = between(random, 0.5, 0.85) if chance(random, 0.3) else 0.0
        canvas.stroke(line, radius * between(random, 0.8, 1.0), strength, hollow)
    if chance(random, 0.35):
        canvas.stroke(line[2:], between(random, 0.1, 0.3) * px_per_mm, scaled(random, 0.05, 0.5))


def _draw_electrodes(
    random: Generator, canvas: Canvas, design: Design, places: Array, headings: Array, shortenings: Array, radius: float,
    metal: float, px_per_mm: float,
) -> Array:  # fmt: skip
    hollow = 0.0 if chance(random, 0.4) else between(random, 0.55, 0.93)
    tip_hollow = hollow if chance(random, 0.3) else 0.0
    wide = radius * between(random, 0.9, 1.12)
    edge = between(random, 0.4, 1.0)
    labels = np.zeros((len(places), LABEL_COLUMNS))
    if chance(random, 0.25):
        _fill_gaps(random, canvas, places, wide, metal, px_per_mm)
    for number, (place, heading, shortening) in enumerate(zip(places, headings, shortenings, strict=True)):
        length = float(design.lengths_mm[number])
        tilted = math.sqrt(max(0.0, 1.0 - shortening * shortening))
        half = 0.5 * length * px_per_mm * shortening + 0.45 * wide * tilted
        # A ray runs a longer way through a band that is seen obliquely.
        strength = metal * between(random, 0.8, 1.2) * min(2.2, 1.0 + 0.3 * length * (1.0 / shortening - 1.0))
        if number and chance(random, 0.02):
            strength *= between(random, 0.2, 0.6)
        canvas.band(
            place, float(heading) + math.pi, half, wide, strength, tip_hollow if number == 0 else hollow,
            number == 0 and not design.loop, edge,
        )  # fmt: skip
        labels[number] = place[0], place[1], float(number == 0), strength, half, wide
    return labels


def _fill_gaps(random: Generator, canvas: Canvas, places: Array, wide: float, metal: float, px_per_mm: float) -> None:
    """Fill short gaps with dark metal.

    Wires, glue and blur merge a tip with its ring, or a pair of rings.
    """
    share = between(random, 0.3, 0.95)
    only_tip = chance(random, 0.5)
    for number in range(1 if only_tip else len(places) - 1):
        step = places[number + 1] - places[number]
        length = float(np.linalg.norm(step))
        if length < 5.0 * px_per_mm and chance(random, 0.8):
            middle = 0.5 * (places[number] + places[number + 1])
            canvas.band(
                middle, math.atan2(step[1], step[0]), 0.25 * length, 0.95 * wide, share * metal, 0.0, False, 0.7
            )


def _draw_sheath(random: Generator, canvas: Canvas, line: Array, radius: float, px_per_mm: float) -> None:
    """Draw a long sheath over the shaft.

    It may have a marker band, which is no electrode.
    """
    if len(line) < 4:
        return
    wide = radius * between(random, 1.2, 1.6)
    canvas.stroke(line, wide, between(random, 0.03, 0.3), between(random, 0.6, 0.85))
    if chance(random, 0.4):
        step = line[1] - line[0]
        canvas.band(
            line[0], math.atan2(step[1], step[0]), between(random, 0.3, 0.8) * px_per_mm, 0.95 * wide, between(random, 0.1, 0.6),
            0.8, False, 0.6,
        )  # fmt: skip
