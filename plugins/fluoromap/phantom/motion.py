"""Motion of the heart: pulses of the beat, field of the ventricular wall, beat-to-beat variation, breathing.

A catheter's tip is displaced by a few fixed vectors (mm), each times a pulse of the beat: ``pulses(t) @ vectors``.
Between the pulses of successive beats the heart rests: that is diastole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fluoromap.phantom.chamber import Chamber

Array = NDArray[np.float64]
HeartKind = Literal["dog", "human"]

HEART_RATE_HZ: dict[HeartKind, tuple[float, float]] = {"dog": (1.6, 2.2), "human": (1.0, 1.6)}
DIASTOLIC_PHASE = 0.8
"""Cardiac phase, counted from the R wave, farthest from systole."""

# Phase of the peak and width (standard deviation) of each pulse, in parts of the cycle: contraction with twist,
# shortening a little later, and an early and a late pulse for each catheter's own motion.
_PEAK = np.array([0.30, 0.32, 0.24, 0.38])
_WIDTH = np.array([0.11, 0.11, 0.11, 0.11])
MODES = len(_PEAK)
_SLOW_PERIOD_S = 1 / 1.6

SHORTENING = 0.14
THICKENING = 0.18
TWIST_DEG = 8.0
ROCKING_MM = 1.5
NON_AFFINE_MM = 0.6
BEAT_AMPLITUDE = 0.04
BEAT_TIMING_CYCLE = 0.25 / 15
BEAT_POSITION_MM = 0.25
BREATHING_HZ = 0.25


def wall_vectors(chamber: Chamber, points_mm: Array, rocking_mm: Array) -> Array:
    """Return the displacement (n, MODES, 3) of points ``(n, 3)`` of the ventricle by each pulse at its peak.

    - The base moves to the apex by 14 %.
    - The wall moves inwards by 18 %.
    - The apex turns against the base by 8 degrees over the ventricle's half length.
    - The whole heart rocks by ``rocking_mm`` (3,), forth early and back late.
    """
    along = chamber.axes[2]
    from_centre = points_mm - chamber.centre_mm
    height = from_centre @ along
    across = from_centre - height[:, None] * along
    half_length = chamber.semi_axes_mm[2]
    turn = np.radians(TWIST_DEG * height / half_length + 2.0)
    vectors = np.zeros((len(points_mm), MODES, 3))
    vectors[:, 0] = -THICKENING * across + turn[:, None] * np.cross(along, across)
    vectors[:, 1] = SHORTENING * (half_length - height)[:, None] * along
    vectors[:, 2], vectors[:, 3] = rocking_mm, -rocking_mm
    return vectors


def non_affine_vectors(rng: np.random.Generator) -> Array:
    """Draw a motion (MODES, 3) of one catheter's own.

    Its standard deviation is 0.6 mm an axis over the cycle.
    """
    vectors = np.zeros((MODES, 3))
    vectors[2:] = rng.normal(size=(2, 3))
    scaled: Array = vectors * (NON_AFFINE_MM / (_cycle_pulses() @ vectors).std(axis=0))
    return scaled


def _cycle_pulses(steps: int = 120) -> Array:
    return Beats.even(1.0, 1.0).pulses(np.arange(steps) / steps)


@dataclass(frozen=True, eq=False)
class Beats:
    """The heart beats of one run.

    period_s : R wave to R wave. r_waves_s : (b,) times of the R waves, from before the first frame to after the last.
    amplitude : (b,) strength of each beat, about 1. delay : (b,) of its contraction, in parts of the cycle.
    offsets_mm : (b, catheters, 3) displacement of each catheter's resting place before the beat.
    """

    period_s: float
    r_waves_s: Array
    amplitude: Array
    delay: Array
    offsets_mm: Array

    @classmethod
    def draw(cls, rate_hz: float, duration_s: float, catheters: int, rng: np.random.Generator) -> Beats:
        """Draw beats from a random phase on.

        Strength varies by 4 %, timing by 0.25 of 1/15 cycle, the resting place by 0.25 mm.
        """
        period = 1 / rate_hz
        count = int(np.ceil(duration_s / period)) + 5
        return cls(
            period,
            np.asarray(period * (np.arange(count) - 2 - rng.uniform()), dtype=np.float64),
            1 + BEAT_AMPLITUDE * np.clip(rng.normal(size=count), -2, 2),
            BEAT_TIMING_CYCLE * rng.normal(size=count),
            BEAT_POSITION_MM * rng.normal(size=(count, catheters, 3)),
        )

    @classmethod
    def even(cls, rate_hz: float, duration_s: float, catheters: int = 1) -> Beats:
        """Return equal beats with the first R wave at 0: the average over beats."""
        period = 1 / rate_hz
        count = int(np.ceil(duration_s / period)) + 5
        zeros = np.zeros(count)
        return cls(
            period,
            np.asarray(period * (np.arange(count) - 2.0), dtype=np.float64),
            zeros + 1,
            zeros,
            np.zeros((count, catheters, 3)),
        )

    def pulses(self, times_s: Array) -> Array:
        """Return the strength (t, MODES) of each pulse at times ``(t,)``."""
        phase = (times_s[:, None] - self.r_waves_s) / self.period_s - self.delay
        # At high rates diastole shortens more than systole.
        width = _WIDTH * max(1.0, float(np.sqrt(_SLOW_PERIOD_S / self.period_s)))
        shape = np.exp(-0.5 * ((phase[..., None] - _PEAK) / width) ** 2)
        strength: Array = np.einsum("tbm,b->tm", shape, self.amplitude)
        return strength

    def rest_mm(self, times_s: Array) -> Array:
        """Return the displacement (t, catheters, 3) of each catheter's resting place at times ``(t,)``.

        It changes from beat to beat during systole, so that diastole stays quiet.
        """
        phase = (times_s[:, None] - self.r_waves_s) / self.period_s - self.delay
        reached = 1 / (1 + np.exp(-np.clip((phase - _PEAK[0]) / 0.06, -40, 40)))
        steps = np.diff(self.offsets_mm, axis=0, prepend=0)
        shift: Array = np.einsum("tb,bcd->tcd", reached, steps)
        return shift

    def phases(self, times_s: Array) -> Array:
        """Return the cardiac phase (t,) at times ``(t,)``.

        It is 0 at an R wave and rises to 1 at the next.
        """
        phase: Array = ((times_s - self.r_waves_s[0]) / self.period_s) % 1.0
        return phase


@dataclass(frozen=True, eq=False)
class Breathing:
    """Breathing position of the heart in one run: a shift of the run and a slow drift within it."""

    shift_mm: Array
    drift_mm: Array
    phase: float

    @classmethod
    def draw(cls, head_feet_mm: float, rng: np.random.Generator) -> Breathing:
        """Draw a shift: uniform within ``head_feet_mm`` along the body, a quarter of it (standard deviation) across."""
        shift = np.array([*(head_feet_mm / 4 * rng.normal(size=2)), head_feet_mm * rng.uniform(-1, 1)])
        return cls(shift, head_feet_mm / 10 * np.array([0.0, 0.3, 1.0]), rng.uniform(0, 2 * np.pi))

    def at(self, times_s: Array) -> Array:
        """Return the shift (t, 3) of the whole heart at times ``(t,)``."""
        drift = np.sin(2 * np.pi * BREATHING_HZ * times_s + self.phase)
        shift: Array = self.shift_mm + drift[:, None] * self.drift_mm
        return shift
