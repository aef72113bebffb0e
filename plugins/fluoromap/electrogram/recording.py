"""The two electrograms of one site on evenly spaced samples, checked as far as times and values go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from fluoromap.contracts import Array

_LEAST_SAMPLES = 20
_SPACING_MS = 0.05, 5.0
"""Recorders sample 200 times a second or more, and DICOM stores up to 20 000 (PS3.3 A.34.5.4.5)."""
_LONGEST_MS = 3_600_000.0
"""One hour: longer recordings are whole procedures, not one site."""
_EVEN = 0.05
"""How far samples may lie from even spacing, as a share of it, and count as evenly spaced."""
_UNIT = "time_ms is in milliseconds"


class UnusableElectrogram(ValueError):
    """An electrogram without an activation time; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Two electrograms on the same evenly spaced samples.

    start_ms, spacing_ms : time of the first sample, and from sample to sample. reference, mapping : (n,) in any unit.
    reference_step, mapping_step : smallest difference between two values, the step of the recorder's converter.
    """

    start_ms: float
    spacing_ms: float
    reference: Array
    mapping: Array
    reference_step: float
    mapping_step: float


def read_recording(time_ms: ArrayLike, reference: ArrayLike, mapping: ArrayLike) -> Recording:
    """Return a recording; unevenly spaced samples become even by cubic splines.

    Parameters
    ----------
    time_ms, reference, mapping : (n,)

    Raises
    ------
    UnusableElectrogram
        When times do not ascend, have gaps or another unit than ms, or when a signal is too short, not finite or flat.
    """
    times = np.asarray(time_ms, dtype=np.float64)
    if times.ndim != 1 or len(times) < _LEAST_SAMPLES:
        raise UnusableElectrogram(f"An electrogram needs at least {_LEAST_SAMPLES} samples.")
    steps = np.diff(times)
    if not np.isfinite(times).all() or not (steps > 0).all():
        raise UnusableElectrogram("The times of an electrogram must be numbers that ascend from sample to sample.")
    _check_spacing(times, steps)
    signals = [
        _checked(np.asarray(signal, dtype=np.float64), times, name)
        for name, signal in (("reference", reference), ("mapping", mapping))
    ]
    least = [_least_step(signal) for signal in signals]
    spacing = float((times[-1] - times[0]) / (len(times) - 1))
    even = times[0] + spacing * np.arange(len(times))
    if np.abs(times - even).max() > _EVEN * spacing:
        signals = [CubicSpline(times, signal)(even) for signal in signals]
    return Recording(float(times[0]), spacing, signals[0], signals[1], least[0], least[1])


def _check_spacing(times: Array, steps: Array) -> None:
    typical, (least, most) = float(np.median(steps)), _SPACING_MS
    if not least <= typical <= most:
        raise UnusableElectrogram(
            f"The samples are {typical:g} ms apart, and recorders take one every {least:g} to {most:g} ms: {_UNIT}; "
            "convert the times."
        )
    gap = int(np.argmax(steps))
    if steps[gap] > max(most, 3.0 * typical):
        raise UnusableElectrogram(
            f"Samples are missing between {times[gap]:g} and {times[gap + 1]:g} ms; send one recording without gaps."
        )
    if times[-1] - times[0] > _LONGEST_MS:
        raise UnusableElectrogram(
            f"The recording has {(times[-1] - times[0]) / 1000.0:.0f} s: {_UNIT}, and one site needs a few beats; send these."
        )


def _checked(signal: Array, times: Array, name: str) -> Array:
    if signal.shape != times.shape:
        raise UnusableElectrogram(f"The {name} electrogram must have one value for each time.")
    if not np.isfinite(signal).all():
        raise UnusableElectrogram(f"The {name} electrogram contains values that are not numbers.")
    if not np.ptp(signal) > 0:
        raise UnusableElectrogram(f"The {name} electrogram is flat; check the electrode's connection.")
    return signal


def _least_step(signal: Array) -> float:
    differences = np.diff(np.unique(signal))
    # Two decimal numbers may differ by the rounding of binary arithmetic alone.
    return float(differences[differences > 1e-9 * np.ptp(signal)].min())
