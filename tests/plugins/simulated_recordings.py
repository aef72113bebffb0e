"""Electrograms drawn from physiology, with their true activation times.

A wave is a dipole that passes an electrode (Plonsey and Barr, Bioelectricity, chapter 8). At a distance h across its path and s
along it, the unipolar voltage is s / (s^2 + h^2)^(3/2), which falls steepest when the wave is nearest. An electrode has a length,
over which it takes the mean. A bipolar electrogram is the difference of two electrodes. Each recorder has a pass band and a
converter. Nothing here is taken from the estimator.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.signal import butter, sosfilt

FINE_KHZ = 8.0
"""The voltages are made 8 times a ms, and then sampled as the recorder does."""


@dataclass
class Recording:
    """One simulated recording; ``lat_ms`` is None where there is nothing to be timed."""

    time_ms: np.ndarray
    reference: np.ndarray
    mapping: np.ndarray
    lat_ms: float | None
    kinds: tuple[str, ...] = field(default=())


def unipolar(ms, speed_mm_ms, distance_mm, length_mm):
    """Return the voltage of a wave that is nearest at 0 ms."""
    # The mean of s / (s^2 + h^2)^(3/2) over the electrode, in closed form.
    near, far = (np.hypot(-speed_mm_ms * ms + end, distance_mm) for end in (-length_mm / 2, length_mm / 2))
    return distance_mm**2 * (1 / near - 1 / far) / length_mm


def repolarisation(ms):
    """Return a T wave, which is slow, of height 1."""
    return np.exp(-0.5 * ((ms - 260.0) / 35.0) ** 2)


class Electrode:
    """One channel at one place: its near field, its far field, and what its amplifier makes of them."""

    def __init__(self, rng, bipolar, rate_khz, far_delay_ms=None, far_share=0.0):
        self.speed = rng.uniform(0.4, 1.2)  # mm per ms, normal and slow tissue
        self.distance = rng.uniform(1.0, 3.0)
        self.length = rng.uniform(1.0, 3.0)
        self.gap = rng.uniform(2.0, 6.0) * rng.choice([0.5, 1.0])
        self.bipolar = bipolar
        self.height = 10 ** rng.uniform(-0.5, 0.7)  # mV
        self.far_delay_ms, self.far_share = far_delay_ms, far_share
        self.far_distance = rng.uniform(20.0, 40.0)
        band = (30.0, min(500.0, 420.0 * rate_khz)) if bipolar else (0.05, 450.0)
        high = min(band[1], 400.0 * rate_khz)
        self.filters = butter(1, [band[0], high], "band", fs=1000.0 * FINE_KHZ, output="sos")

    def near(self, ms):
        if not self.bipolar:
            return self.height * 2.6 * unipolar(ms, self.speed, self.distance, self.length)
        half = self.gap / 2 / self.speed
        pair = [unipolar(ms + shift, self.speed, self.distance, self.length) for shift in (half, -half)]
        return self.height * (pair[0] - pair[1])

    def far(self, ms):
        if self.far_delay_ms is None:
            return np.zeros(len(ms))
        return (
            self.height * self.far_share * 2.6 * unipolar(ms - self.far_delay_ms, 0.8, self.far_distance, self.length)
        )

    def filtered(self, voltage):
        return sosfilt(self.filters, voltage)

    def steepest_ms(self):
        """Return when the near field of a wave at 0 ms falls steepest.

        It is filtered and has no noise.
        """
        ms = np.arange(-150, 150, 1 / FINE_KHZ)
        return float(ms[np.argmin(np.gradient(self.filtered(self.near(ms))))])


def draw_recording(rng, *forced):
    """Draw a recording; ``forced`` names kinds that it must have."""
    kinds = set(forced)

    def has(kind, odds):
        if rng.random() < odds:
            kinds.add(kind)
        return kind in kinds

    rate_khz = float(rng.choice([0.5, 0.977, 1.0, 2.0, 4.0]))
    cycle = rng.uniform(330, 1000)
    beats = 1 if has("one beat", 0.1) else int(rng.integers(2, 9))
    bipolar = rng.random() < 0.5
    kinds.add("bipolar" if bipolar else "unipolar")
    conduction = rng.uniform(-110, 150)
    atrium = has("far field of the other chamber", 0.25)
    delay = rng.uniform(120, 200)
    reference = Electrode(rng, bipolar, rate_khz, delay if atrium else None, rng.uniform(0.3, 3.0))
    mapping = Electrode(rng, bipolar, rate_khz, delay - conduction if atrium else None, rng.uniform(0.3, 3.0))
    starts = rng.uniform(180, 180 + 0.4 * cycle) + cycle * np.arange(beats) + rng.normal(0, 0.02 * cycle, beats)
    duration = starts[-1] + rng.uniform(200, 200 + 0.4 * cycle)
    fine = np.arange(-600.0, duration, 1 / FINE_KHZ)
    voltage = np.zeros((2, len(fine)))
    ectopic = int(rng.integers(1, beats - 1)) if beats >= 5 and has("ectopic beat", 0.3) else -1
    jitter = rng.uniform(0.0, 1.0)
    swing = 0.2 * rng.random() * np.sin(2 * np.pi * starts / 4000.0)
    beat_starts = [starts[0] - cycle, *starts]  # the beat before the recording may reach into it
    deviations = rng.normal(0, jitter, beats + 1)
    for number, start in enumerate(beat_starts, -1):
        lats = np.array([0.0, conduction + deviations[number + 1]])
        sizes = np.ones(2) * (1.0 + (swing[number] if number >= 0 else 0.0))
        electrodes = [reference, mapping]
        if number == ectopic:
            start -= rng.uniform(0.2, 0.4) * cycle
            lats[1] = rng.uniform(-120, 120)
            electrodes = [Electrode(rng, bipolar, rate_khz) for _ in range(2)]
            for electrode, usual in zip(electrodes, (reference, mapping), strict=True):
                electrode.height = usual.height * 10 ** rng.uniform(-0.5, 0.5)
        for row, (electrode, at) in enumerate(zip(electrodes, start + lats, strict=True)):
            ms = fine - at
            voltage[row] += sizes[row] * (electrode.near(ms) + electrode.far(ms))
            if not bipolar:
                voltage[row] += 0.2 * electrode.height * repolarisation(ms)
    heights = np.array([reference.height, mapping.height])
    paced = has("pacing artefact", 0.15)
    if paced:
        for start in starts:
            at = start + min(0.0, conduction) - rng.uniform(25, 60)
            pulse, tail = rng.uniform(0.5, 2.0), rng.uniform(5, 30)
            size, after = rng.choice([-1, 1]) * rng.uniform(2, 10), rng.uniform(0, 0.4)
            ms = fine - at
            spike = size * ((ms >= 0) & (ms < pulse)) - after * size * (ms >= pulse) * np.exp(
                -np.maximum(ms - pulse, 0.0) / tail
            )
            voltage += spike * rng.uniform(0.5, 1.5, (2, 1))
    if has("far field only", 0.04):
        voltage[1] -= voltage[1]
        for start in beat_starts:
            voltage[1] += 2.6 * unipolar(fine - start - conduction, 0.8, rng.uniform(25, 40), 4.0)
    voltage = np.array([electrode.filtered(row) for electrode, row in zip((reference, mapping), voltage, strict=True)])
    if has("hum", 0.2):
        hz = rng.choice([50.0, 60.0])
        wave = sum(np.sin(2 * np.pi * hz * k * fine / 1000 + rng.uniform(0, 6)) / k**2 for k in (1, 2, 3))
        voltage += heights[:, None] * rng.uniform(0.01, 0.06, (2, 1)) * wave
    if has("drift", 0.2):
        voltage += (
            heights[:, None]
            * rng.uniform(0.5, 2.0)
            * np.sin(2 * np.pi * fine / rng.uniform(2500, 5000) + rng.uniform(0, 6))
        )
    count = int(duration * rate_khz)
    time_ms = np.arange(count) / rate_khz
    sampled = np.array([np.interp(time_ms, fine, row) for row in voltage])
    noise = heights * 10 ** rng.uniform(-2.5, -1.2, 2)
    sampled += noise[:, None] * rng.normal(size=sampled.shape)
    step = 10 ** rng.uniform(-4, -2)  # mV
    # The time of a site is the mean of the beats that were recorded.
    lat = (
        conduction
        + np.mean(np.delete(deviations[1:], [ectopic] if ectopic >= 0 else []))
        + mapping.steepest_ms()
        - reference.steepest_ms()
    )
    if "far field only" in kinds:
        lat = None
    for row, kind in enumerate(("dead reference", "dead mapping")):
        if has(kind, 0.04):
            lat = None
            least = rng.choice([0.1, 0.5, 2.0])
            sampled[row] = step * least * rng.normal(size=count)
            if paced:
                sampled[row] += np.array(
                    [np.interp(time_ms, fine, row_of) for row_of in [electrode_spikes(fine, starts)]]
                )[0]
    sampled = np.round(sampled / step) * step
    if has("saturated", 0.04):
        row = int(rng.integers(2))
        if np.ptp(sampled[row]) > 10 * step:
            most = 0.4 * np.abs(sampled[row]).max()
            sampled[row] = np.clip(sampled[row], -most, most)
            kinds.add("clipped")
    if has("offset", 0.1):
        sampled += rng.uniform(-5, 5, (2, 1))
    return Recording(time_ms + rng.uniform(0, 1e5) * has("late start", 0.2), *sampled, lat, tuple(sorted(kinds)))


def electrode_spikes(fine, starts):
    """Return the stimuli that a dead channel picks up."""
    spikes = np.zeros(len(fine))
    for start in starts:
        spikes[(fine >= start - 40) & (fine < start - 39)] = 3.0
    return spikes
