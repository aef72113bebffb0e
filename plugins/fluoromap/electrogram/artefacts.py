"""Artefacts of stimulators and recorders: spikes that no tissue makes, and clipped values."""

from __future__ import annotations

import numpy as np
from scipy.signal import find_peaks

from fluoromap.contracts import Array, BoolArray
from fluoromap.electrogram.quiet_part import quiet_sd
from fluoromap.electrogram.recording import Recording

_PULSE_MS = 2.5
"""Stimulators send pulses of 0.5 to 2 ms, which an amplifier with 450 Hz lengthens by half a millisecond."""
_NO_TISSUE_MS = 1.6
"""A lobe of an electrogram is wider: an electrode of 1 mm and more needs longer to be passed, even at 1 m/s."""
_ONE_SAMPLE = 1.1
"""A spike of one sample is as wide as the spacing of samples; the lobes of electrograms have more."""
_SAME_TIME_MS = 1.0
"""A stimulus reaches all channels at once; a sample's rounding is left."""
_ABOVE_NOISE = 12.0
_HARMLESS = 0.2
"""Part of a signal's extent below which a spike is less steep than its deflections, once cubics are fitted over 10 ms."""
_SETTLED = 0.1
"""The spike has ended where the signal changes by less than this part of its height in a millisecond."""
_LONGEST_SPIKE_MS = 12.0
_AROUND_MS = 1.0
_SATURATED_MS = 3.0
_SATURATED_SAMPLES = 5
_ABRUPT = 0.05
_BASELINE = 0.1


def without_spikes(recording: Recording) -> tuple[Array, Array, BoolArray, int]:
    """Replace the spikes of both electrograms by straight lines.

    A spike rises and falls within 2.5 ms in both electrograms at the same time, or within 1.6 ms or one sample in one. Tissue is
    slower: the wave needs longer to pass an electrode.

    Returns
    -------
    reference, mapping : (n,)
    blanked : (n,)
        Samples that were replaced, in both electrograms.
    spikes : int
    """
    spacing = recording.spacing_ms
    signals = recording.reference, recording.mapping
    found = [
        _narrow_peaks(signal, step, spacing)
        for signal, step in zip(signals, (recording.reference_step, recording.mapping_step), strict=True)
    ]
    blanked = np.zeros(len(signals[0]), bool)
    tolerance = max(_SAME_TIME_MS / spacing, 1.0)
    for own, other in (found, found[::-1]):
        for peak, (width_ms, _) in own.items():
            together = any(abs(peak - place) <= tolerance for place in other)
            alone = width_ms <= max(_NO_TISSUE_MS, _ONE_SAMPLE * spacing)
            if together or alone:
                _blank(blanked, peak, [peaks.get(peak, (0.0, 0.0))[1] for peaks in found], signals, spacing)
    starts = np.flatnonzero(np.diff(np.concatenate([[False], blanked]).astype(np.int8)) == 1)
    if not len(starts) or blanked.all():
        return *signals, blanked, len(starts)
    index, kept = np.arange(len(blanked)), ~blanked
    reference, mapping = (np.where(blanked, np.interp(index, index[kept], signal[kept]), signal) for signal in signals)
    return reference, mapping, blanked, len(starts)


def _narrow_peaks(signal: Array, step: float, spacing: float) -> dict[int, tuple[float, float]]:
    """Return the width (ms) and the height of the narrow peaks of a signal, by sample."""
    # Of white noise, differences of neighbours show the noise alone, whatever the signal.
    noise = max(quiet_sd(np.diff(signal)) / np.sqrt(2.0), step)
    least = max(_ABOVE_NOISE * noise, _HARMLESS * float(np.ptp(signal)))
    narrow: dict[int, tuple[float, float]] = {}
    for sign in (1.0, -1.0):
        peaks, shape = find_peaks(sign * signal, prominence=least, width=0.0, rel_height=0.5)
        for peak, width, height in zip(peaks, shape["widths"] * spacing, shape["prominences"], strict=True):
            if width <= _PULSE_MS:
                narrow[int(peak)] = float(width), float(height)
    return narrow


def _blank(blanked: BoolArray, peak: int, heights: list[float], signals: tuple[Array, Array], spacing: float) -> None:
    most, around = round(_LONGEST_SPIKE_MS / spacing), max(1, round(_AROUND_MS / spacing))
    step = max(1, round(1.0 / spacing))
    first, last = max(0, peak - round(_PULSE_MS / spacing) - around), peak
    for signal, height in zip(signals, heights, strict=True):
        end = min(peak + most, len(signal) - step - 1)
        changes = np.abs(signal[peak + step : end + step] - signal[peak:end])
        moving = np.flatnonzero(changes > _SETTLED * max(height, 1e-12)) if height else np.zeros(0, np.int64)
        last = max(last, peak + int(moving[-1]) + step if len(moving) else peak)
    blanked[first : last + around + 1] = True


def is_saturated(signal: Array, spacing_ms: float) -> bool:
    """Return whether the signal stays at an extreme that it reaches at speed.

    A smooth plateau is reached slowly.
    """
    extent, middle = float(np.ptp(signal)), float(np.median(signal))
    held = max(_SATURATED_SAMPLES, round(_SATURATED_MS / spacing_ms))
    return any(
        abs(rail - middle) > _BASELINE * extent and _is_clipped(signal, float(rail), held)
        for rail in (signal.min(), signal.max())
    )


def _is_clipped(signal: Array, rail: float, least_samples: int) -> bool:
    held = np.concatenate([[False], signal == rail, [False]])
    edges = np.flatnonzero(np.diff(held.astype(np.int8)))
    first, behind = edges[::2], edges[1::2]
    if int((behind - first).max(initial=0)) < least_samples:
        return False
    steps = [abs(signal[index] - signal[index - 1]) for index in first if index >= 1]
    steps += [abs(signal[index] - signal[index - 1]) for index in behind if index < len(signal)]
    return bool(steps) and bool(max(steps) > _ABRUPT * np.abs(np.diff(signal)).max())
