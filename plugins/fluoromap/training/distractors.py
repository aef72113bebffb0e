"""Things in fluoroscopy that are no electrodes: cables, wires, probes, clips, vessels, devices. They carry no labels.

A network trained without them answers to everything that is dark and small: they decide the result.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from fluoromap.contracts import Array
from fluoromap.training.drawing import Canvas
from fluoromap.training.randomness import Curve, between, chance, random_curve, scaled

_STEP_MM = 1.0


def draw_distractors(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a random choice of distractors."""
    for draw, often in _KINDS:
        left = often
        while left > 0:
            if chance(random, min(left, 1.0) if left < 1.0 else 0.6):
                draw(random, canvas, px_per_mm)
            left -= 1.0


def _placed(random: Generator, canvas: Canvas, curve: Curve, px_per_mm: float) -> Array:
    """Put a random point of the curve somewhere in the scene; (n, 2) pixels."""
    anchor = curve.points_mm[int(random.integers(len(curve.points_mm)))]
    placed: Array = (curve.points_mm - anchor) * px_per_mm + random.uniform(0.0, canvas.size, 2)
    return placed


def _long_line(
    random: Generator, canvas: Canvas, px_per_mm: float, bend: float, step_mm: float = _STEP_MM
) -> tuple[Array, Array]:
    """Draw points (pixels) and headings of a line across the scene.

    The line is about in the image plane.
    """
    length = between(random, 0.6, 2.2) * canvas.size / px_per_mm
    curve = random_curve(random, length, step_mm, bend, tilt=0.0, tilt_change=between(random, 0.0, 0.5))
    return _placed(random, canvas, curve, px_per_mm), curve.heading


def _square(heading: Array) -> Array:
    return np.stack([-np.sin(heading), np.cos(heading)], axis=1)


def _cable(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw ECG cables and other lines of any width.

    Sometimes it is a bundle of them.
    """
    line, heading = _long_line(random, canvas, px_per_mm, between(random, 0.0, 1.2))
    hollow = between(random, 0.3, 0.8) if chance(random, 0.3) else 0.0
    radius = scaled(random, 0.15, 2.3) * px_per_mm
    canvas.stroke(line, radius, scaled(random, 0.05, 0.9), hollow)
    if chance(random, 0.3):
        canvas.stroke(line, 0.4 * radius, scaled(random, 0.05, 0.6))
    if chance(random, 0.3):
        for _ in range(int(random.integers(1, 4))):
            beside = _square(heading) * (random.normal() * 3.0 * px_per_mm)
            canvas.stroke(line + beside, scaled(random, 0.2, 1.5) * px_per_mm, scaled(random, 0.05, 0.9))


def _ecg_electrode(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a cable that ends in a snap: a ring, a plug, a rod."""
    line, heading = _long_line(random, canvas, px_per_mm, between(random, 0.0, 1.0))
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


def _guide_wire(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a thin wire, often curled, sometimes with a denser end."""
    line, _ = _long_line(random, canvas, px_per_mm, between(random, 0.5, 3.5))
    canvas.stroke(line, scaled(random, 0.1, 0.45) * px_per_mm, scaled(random, 0.1, 1.0))
    if chance(random, 0.5):
        end = line[: int(random.integers(4, max(6, len(line) // 2)))]
        canvas.stroke(end, between(random, 0.15, 0.45) * px_per_mm, scaled(random, 0.2, 1.2))


def _sheath(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a hollow tube without electrodes, perhaps with one marker band."""
    line, heading = _long_line(random, canvas, px_per_mm, between(random, 0.0, 1.5))
    wide = between(random, 0.8, 2.2) * px_per_mm
    canvas.stroke(line, wide, scaled(random, 0.05, 0.5), between(random, 0.5, 0.88))
    if chance(random, 0.5):
        k = int(random.integers(len(line)))
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


def _plain_catheter(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw an angiography catheter or a Swan-Ganz catheter.

    It is a shaft that ends without electrodes, hooked or curled.
    """
    curve = random_curve(random, between(random, 40.0, 120.0), 0.5, between(random, 0.8, 4.0), tilt_change=0.3)
    line = _placed(random, canvas, curve, px_per_mm)
    canvas.stroke(
        line,
        between(random, 0.6, 1.3) * px_per_mm,
        scaled(random, 0.1, 0.9),
        0.0 if chance(random, 0.4) else between(random, 0.4, 0.8),
    )
    if chance(random, 0.3):
        canvas.band(line[0], float(curve.heading[0]), between(random, 0.3, 1.5) * px_per_mm, between(random, 0.6, 1.3) * px_per_mm,
                    scaled(random, 0.1, 1.0), 0.0, True, 0.7)  # fmt: skip


def _coil(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a shock coil of a defibrillator's lead, a spring, a braid: a dense zigzag along a line."""
    curve = random_curve(random, between(random, 15.0, 60.0), 0.25, between(random, 0.0, 1.5), tilt=0.0)
    line = _placed(random, canvas, curve, px_per_mm)
    swing = between(random, 0.4, 1.6) * px_per_mm
    phase = 2.0 * math.pi * np.arange(len(line)) * 0.25 / scaled(random, 0.5, 4.0)
    canvas.stroke(line + _square(curve.heading) * (swing * np.sin(phase))[:, None], between(random, 0.1, 0.35) * px_per_mm,
                  scaled(random, 0.1, 0.9))  # fmt: skip
    if chance(random, 0.6):
        canvas.stroke(line, swing, scaled(random, 0.1, 0.9))


def _vessels(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
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


def _drained_tube(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw a vessel or tube that the contrast medium has left.

    A few plugs and rims remain, which lie in a row like electrodes.
    """
    curve = random_curve(random, between(random, 15.0, 70.0), 0.5, between(random, 0.2, 2.0), tilt=0.0)
    line = _placed(random, canvas, curve, px_per_mm)
    radius, dark = between(random, 0.7, 2.2) * px_per_mm, scaled(random, 0.1, 1.5)
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


def _residue(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw contrast medium left in crumbs along a line or an edge."""
    line, heading = _long_line(random, canvas, px_per_mm, between(random, 0.2, 2.0))
    dark = scaled(random, 0.1, 1.5)
    wide = scaled(random, 0.3, 3.0) * px_per_mm
    for k in random.integers(0, len(line), int(random.integers(5, 40))).tolist():
        at = line[k] + _square(heading[k : k + 1])[0] * (random.normal() * wide)
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


def _echo_probe(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
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


def _segmented_shaft(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw the shaft of an echo probe or an endoscope without its head."""
    _segments(random, canvas, px_per_mm, random.uniform(-0.1, 1.1, 2) * canvas.size, between(random, 0.0, 6.3),
              between(random, 2.0, 5.5) * px_per_mm)  # fmt: skip


def _segments(random: Generator, canvas: Canvas, px_per_mm: float, start: Array, angle: float, half: float) -> None:
    curve = random_curve(random, between(random, 40.0, 120.0), 0.5, between(random, 0.2, 1.5), tilt=0.0)
    turn = angle - float(curve.heading[0])
    cosine, sine = math.cos(turn), math.sin(turn)
    line = curve.points_mm @ np.array([[cosine, sine], [-sine, cosine]]) * px_per_mm + start
    canvas.stroke(line, half, between(random, 0.1, 0.6), between(random, 0.5, 0.9))
    pitch = between(random, 2.0, 7.0)
    long, dark, wide = pitch * between(random, 0.15, 0.6), scaled(random, 0.08, 0.9), half * between(random, 0.5, 1.0)
    hollow = 0.0 if chance(random, 0.6) else between(random, 0.6, 0.9)
    for arc in np.arange(0.0, 0.5 * (len(line) - 1), pitch):
        k = int(2.0 * arc)
        canvas.band(
            line[k],
            float(curve.heading[k]) + turn,
            0.5 * long * px_per_mm,
            wide,
            dark * between(random, 0.8, 1.2),
            hollow,
            False,
            0.8,
        )


def _temperature_probe(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw an oesophageal temperature probe.

    It is a soft shaft with one to five olives wider than itself, or a metal cap at its end.
    """
    line, heading = _long_line(random, canvas, px_per_mm, between(random, 0.2, 1.2), 0.5)
    radius = between(random, 1.0, 2.5) * px_per_mm
    canvas.stroke(line, radius, scaled(random, 0.04, 0.4), between(random, 0.0, 0.8))
    canvas.stroke(line, 0.15 * px_per_mm, scaled(random, 0.05, 0.5))
    pitch = int(2 * between(random, 8.0, 20.0))
    for k in range(0, min(len(line), pitch * int(random.integers(1, 6))), pitch):
        canvas.disc(line[k], between(random, 1.5, 4.0) * px_per_mm, radius * between(random, 1.1, 1.6), float(heading[k]),
                    scaled(random, 0.2, 1.2), 1.0, between(random, 2.0, 3.0))  # fmt: skip


def _clip(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
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


def _blob(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
    """Draw one dense thing of electrode size without a catheter.

    It is calcium, a bead, a screw's head or a marker.
    """
    at = random.uniform(0.0, canvas.size, 2)
    canvas.disc(at, scaled(random, 0.4, 2.5) * px_per_mm, scaled(random, 0.4, 2.0) * px_per_mm, between(random, 0.0, 6.3),
                scaled(random, 0.1, 1.3), between(random, 0.6, 2.0), between(random, 2.0, 5.0))  # fmt: skip


def _sternal_wire(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
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


def _valve_ring(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
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


def _device(random: Generator, canvas: Canvas, px_per_mm: float) -> None:
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


_KINDS: tuple[tuple[Callable[[Generator, Canvas, float], None], float], ...] = (
    (_cable, 2.0),
    (_ecg_electrode, 0.25),
    (_guide_wire, 1.3),
    (_sheath, 0.35),
    (_plain_catheter, 0.3),
    (_coil, 0.17),
    (_vessels, 0.38),
    (_drained_tube, 0.25),
    (_residue, 0.18),
    (_echo_probe, 0.1),
    (_segmented_shaft, 0.08),
    (_temperature_probe, 0.15),
    (_clip, 0.5),
    (_blob, 0.7),
    (_sternal_wire, 0.2),
    (_valve_ring, 0.12),
    (_device, 0.07),
)
"""How often a scene has each kind; above 1 is the mean of several."""
