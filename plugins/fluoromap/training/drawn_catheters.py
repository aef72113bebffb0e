"""Catheters of all kinds drawn into a scene, with the place of each electrode as its label."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array
from fluoromap.training.courses import beside, to_border
from fluoromap.training.drawing import Canvas
from fluoromap.training.randomness import Curve, between, chance, loop_curve, random_curve, scaled

LABEL_COLUMNS = 6
"""u, v (pixels), 1 for a tip, attenuation, half length seen and radius (pixels) of an electrode."""

_STEP_MM = 0.5
_DARKEST_SHAFT = 1.5
_MOST_OBLIQUE = 2.2
_OTHER_BRAID = 0.3
_IN_PLANE, _LEAST_SEEN = 0.97, 0.2
"""Shortening from which on a ring shows none of its openings, and the least that is drawn."""
_SIDE_BY_SIDE = 0.2
_LONG_TIP_MM, _SHORT_GAP_MM, _MERGED_TIPS = 3.0, 3.0, 0.5
"""A long tip's thermocouple and leads often make one dark bar of the tip and a ring that is near."""
_FRENCH_RADII_MM = 0.67, 0.83, 1.0, 1.0, 1.0, 1.17, 1.17, 1.33


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """What a maker fixes: electrode centres from the tip's far end on and lengths, both along the shaft, mm."""

    centres_mm: Array
    lengths_mm: Array
    loop: bool = False

    @property
    def merges_tip(self) -> bool:
        """Whether the tip is long and the next ring near, so that the two often show as one bar."""
        gap = float(self.centres_mm[1] - self.centres_mm[0] - 0.5 * self.lengths_mm[:2].sum())
        return float(self.lengths_mm[0]) >= _LONG_TIP_MM and gap <= _SHORT_GAP_MM


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
        electrodes, tip = 4, _diagnostic_tip(random)
    elif kind < 0.64:
        electrodes, tip = int(random.integers(5, 9)), _diagnostic_tip(random)
    elif kind < 0.89:
        electrodes, tip = 10, _diagnostic_tip(random)
    elif kind < 0.95:
        electrodes, tip = int(random.choice([12, 14, 16, 20])), _diagnostic_tip(random)
    else:
        electrodes, tip = int(random.integers(8, 21)), ring
        return _design(np.full(electrodes - 1, scaled(random, 1.5, 6.0)), ring, tip, loop=True)
    return _design(_gaps(random, electrodes - 1), ring, tip)


def _diagnostic_tip(random: Generator) -> float:
    """Draw the length of a tip electrode, mm: mostly about 2, longer than the rings."""
    return between(random, 1.7, 2.4) if chance(random, 0.6) else between(random, 1.0, 2.5)


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


def draw_catheters(
    random: Generator, canvas: Canvas, px_per_mm: float, designs: Sequence[Design], metal_between: tuple[float, float]
) -> Array:
    """Draw catheters somewhere in the scene, their electrodes of attenuations in ``metal_between``.

    Some lie beside the one drawn before, as in the coronary sinus or in one sheath.

    Returns
    -------
    (electrodes, LABEL_COLUMNS) one row an electrode, catheter after catheter, from the tip on.
    """
    labels = [np.zeros((0, LABEL_COLUMNS))]
    course: Curve | None = None
    for design in designs:
        companion = None if course is None or not chance(random, _SIDE_BY_SIDE) else _companion(random, course, design)
        course = companion or _course(random, design, canvas.size / px_per_mm)
        labels.append(_draw_along(random, canvas, px_per_mm, design, course, metal_between))
    return np.concatenate(labels)


def _companion(random: Generator, course: Curve, design: Design) -> Curve | None:
    """Draw a course beside another one that is long enough."""
    ahead = scaled(random, 1.0, 30.0)
    needed = ahead + float(design.centres_mm[-1]) + 15.0
    return None if design.loop or len(course.points_mm) * course.step_mm < needed else beside(random, course, ahead)


def _draw_along(
    random: Generator, canvas: Canvas, px_per_mm: float, design: Design, course: Curve,
    metal_between: tuple[float, float],
) -> Array:  # fmt: skip
    course = to_border(course, canvas.size / px_per_mm)
    centres, headings, shortenings = course.at(design.centres_mm)
    line, places = course.points_mm * px_per_mm, centres * px_per_mm
    radius = float(random.choice(_FRENCH_RADII_MM)) * px_per_mm
    metal = scaled(random, *metal_between)
    _draw_shaft(random, canvas, line, _shaft_depth(random, course, design), radius, metal, px_per_mm)
    labels = _draw_electrodes(random, canvas, design, places, headings, shortenings, radius, metal, px_per_mm)
    behind = float(design.centres_mm[-1]) + between(random, 3.0, 45.0)
    if chance(random, 0.2):
        _draw_sheath(random, canvas, line[int(behind / _STEP_MM) :], radius, px_per_mm)
    return labels


def _course(random: Generator, design: Design, scene_mm: float) -> Curve:
    """Draw a course from the tip on, with one of the electrodes in the scene."""
    length = float(design.centres_mm[-1])
    shaft = between(random, 0.4, 1.5) * scene_mm
    if design.loop:
        turns = between(random, 0.75, 1.05)
        curve = loop_curve(random, max(length / (2.0 * math.pi * turns), 5.0), turns, shaft, _STEP_MM)
    else:
        curve = random_curve(
            random, length + shaft, _STEP_MM, between(random, 0.3, 1.8), tilt_change=between(random, 0.0, 0.6)
        )
    centres, _, _ = curve.at(design.centres_mm)
    return curve.moved(random.uniform(0.05, 0.95, 2) * scene_mm - centres[int(random.integers(len(centres)))])


def _shaft_depth(random: Generator, course: Curve, design: Design) -> Array:
    """Return the shaft's attenuation along its course.

    It is 1 where the shaft lies in the image plane: a ray runs a longer way through a shaft that is seen obliquely. Behind the
    bendable end some shafts have another braid.
    """
    depth: Array = np.minimum(1.0 / course.shortening, _MOST_OBLIQUE)
    if chance(random, _OTHER_BRAID):
        from_mm = float(design.centres_mm[-1]) + between(random, 4.0, 50.0)
        arc = np.arange(len(depth)) * course.step_mm
        depth *= 1.0 + between(random, -0.4, 1.2) * np.clip((arc - from_mm) / 2.0, 0.0, 1.0)
    return depth


def _draw_shaft(
    random: Generator, canvas: Canvas, line: Array, depth: Array, radius: float, metal: float, px_per_mm: float
) -> None:
    kind = random.random()
    if kind < 0.06:
        strength = 0.0
    elif kind < 0.82:
        strength = min(min(metal, _DARKEST_SHAFT) * between(random, 0.04, 0.7), 0.8)
    else:
        strength = between(random, 0.02, 0.3)
    if strength > 0:
        hollow = between(random, 0.5, 0.85) if chance(random, 0.3) else 0.0
        canvas.stroke(line, radius * between(random, 0.8, 1.0), strength * depth, hollow)
    if chance(random, 0.35):
        canvas.stroke(line[2:], between(random, 0.1, 0.3) * px_per_mm, scaled(random, 0.05, 0.5) * depth[2:])


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
    elif design.merges_tip and chance(random, _MERGED_TIPS):
        near, far = 0.5 * design.lengths_mm[:2] * shortenings[:2] * px_per_mm
        toward = (places[1] - places[0]) / max(float(np.linalg.norm(places[1] - places[0])), 1e-6)
        _fill_gap(
            canvas, places[0] + near * toward, places[1] - far * toward, 0.5, wide, between(random, 0.5, 1.0) * metal
        )
    for number, (place, heading, shortening) in enumerate(zip(places, headings, shortenings, strict=True)):
        length = float(design.lengths_mm[number])
        tilted = math.sqrt(max(0.0, 1.0 - shortening * shortening))
        half = 0.5 * length * px_per_mm * shortening + 0.45 * wide * tilted
        even = metal * between(random, 0.8, 1.2)
        if number and chance(random, 0.02):
            even *= between(random, 0.2, 0.6)
        # A ray runs a longer way through a band that is seen obliquely.
        strength = even * min(_MOST_OBLIQUE, 1.0 + 0.3 * length * (1.0 / shortening - 1.0))
        own_hollow = tip_hollow if number == 0 else hollow
        if own_hollow > 0.0 and shortening < _IN_PLANE:
            canvas.ring(
                place,
                float(heading),
                0.5 * length * px_per_mm,
                wide,
                even,
                own_hollow,
                max(float(shortening), _LEAST_SEEN),
            )
        else:
            dome = number == 0 and not design.loop
            canvas.band(place, float(heading) + math.pi, half, wide, strength, own_hollow, dome, edge)
        labels[number] = place[0], place[1], float(number == 0), strength, half, wide
    return labels


def _fill_gaps(random: Generator, canvas: Canvas, places: Array, wide: float, metal: float, px_per_mm: float) -> None:
    """Fill short gaps with dark metal.

    Wires, glue and blur merge a tip with its ring, or a pair of rings.
    """
    share = between(random, 0.3, 0.95)
    only_tip = chance(random, 0.5)
    for number in range(1 if only_tip else len(places) - 1):
        length = float(np.linalg.norm(places[number + 1] - places[number]))
        if length < 5.0 * px_per_mm and chance(random, 0.8):
            _fill_gap(canvas, places[number], places[number + 1], 0.25, wide, share * metal)


def _fill_gap(canvas: Canvas, place: Array, following: Array, half: float, wide: float, strength: float) -> None:
    """Draw a band in the middle between two places.

    ``half`` : half its length over their distance.
    """
    step = following - place
    heading, length = math.atan2(step[1], step[0]), half * float(np.linalg.norm(step))
    canvas.band(0.5 * (place + following), heading, length, 0.95 * wide, strength, 0.0, False, 0.7)


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
