"""Local activation time: the steepest negative deflection of the mapping electrogram minus the reference's.

The paper samples 1000 times a second; here the samples may lie anywhere, as long as times ascend.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fluoromap.contracts import Array

_LEAST_SAMPLES = 20
_WINDOW_MS = 5.0
_LEAST_WINDOW = 5
_SATURATED_SAMPLES = 5
_ABRUPT = 0.05
_BASELINE = 0.1
_LEAST_SLOPE_TO_NOISE = 6.0
_RIVAL = 0.8
_PLACEMENT = 0.05
_RIVAL_AWAY_MS = 10.0


class UnusableElectrogram(ValueError):
    """No activation time can be read off this electrogram; the message says why."""


@dataclass(frozen=True, slots=True)
class ElectrogramResult:
    """lat_ms : mapping minus reference. sd_ms : its standard deviation. reference_ms, mapping_ms : the deflections' times.
    warnings : sentences about what to check."""

    lat_ms: float
    sd_ms: float
    reference_ms: float
    mapping_ms: float
    warnings: tuple[str, ...]


def activation_time(time_ms: ArrayLike, reference: ArrayLike, mapping: ArrayLike) -> ElectrogramResult:
    """Local activation time of one site from its two electrograms.

    The slope at each sample is that of a quadratic fitted to the samples within 5 ms on each side (Savitzky and Golay,
    Anal. Chem. 36 (1964) 1627, for samples at any spacing); the minimum is placed between samples by a parabola. Its
    standard deviation follows from the noise about the fits and from how sharp the minimum is.

    Parameters
    ----------
    time_ms, reference, mapping : (n,)
        Times, strictly ascending, and the two signals in any unit.

    Raises
    ------
    UnusableElectrogram
        Naming the signal that is too short, not finite, flat, saturated or without a deflection that stands out from noise;
        or when times do not ascend.
    """
    times = np.asarray(time_ms, dtype=np.float64)
    if times.ndim != 1 or len(times) < _LEAST_SAMPLES:
        raise UnusableElectrogram(f"An electrogram needs at least {_LEAST_SAMPLES} samples.")
    if not np.isfinite(times).all() or not (np.diff(times) > 0).all():
        raise UnusableElectrogram("The times of an electrogram must be numbers that ascend from sample to sample.")
    warnings: list[str] = []
    found = [
        _deflection(times, np.asarray(signal, dtype=np.float64), name, warnings)
        for name, signal in (("reference", reference), ("mapping", mapping))
    ]
    (reference_ms, reference_sd), (mapping_ms, mapping_sd) = found
    return ElectrogramResult(
        mapping_ms - reference_ms, math.hypot(reference_sd, mapping_sd), reference_ms, mapping_ms, tuple(warnings)
    )


def local_slope(times: Array, signal: Array) -> tuple[Array, Array, float]:
    """(slope, its standard error for unit noise, noise) of quadratics fitted to 5 ms on each side of each sample.

    slope, error : (n,), per ms. noise : robust standard deviation of the samples about their fits.
    """
    n = len(times)
    index = np.arange(n)
    first = np.searchsorted(times, times - _WINDOW_MS - 1e-9)
    last = np.searchsorted(times, times + _WINDOW_MS + 1e-9)
    # Where samples are sparse a fit still needs two on each side.
    first = np.minimum(first, np.maximum(index - _LEAST_WINDOW // 2, 0))
    last = np.maximum(last, np.minimum(index + _LEAST_WINDOW // 2 + 1, n))
    column = np.arange(int((last - first).max()))
    sample = first[:, None] + column[None, :]
    used = sample < last[:, None]
    sample = np.minimum(sample, n - 1)
    x = np.where(used, times[sample] - times[:, None], 0.0)
    scale = np.abs(x).max(axis=1, keepdims=True)
    x /= scale
    design = np.stack([used.astype(np.float64), x, x * x], axis=2)
    inverse = np.linalg.pinv(np.einsum("nki,nkj->nij", design, design), hermitian=True)
    values = np.where(used, signal[sample], 0.0)
    fitted = np.einsum("nij,nkj,nk->ni", inverse, design, values)
    slopes = fitted[:, 1] / scale[:, 0]
    errors = np.sqrt(np.maximum(inverse[:, 1, 1], 0.0)) / scale[:, 0]
    residual = np.where(used, values - np.einsum("nki,ni->nk", design, fitted), 0.0)
    rest = (residual**2).sum(axis=1) / np.maximum(used.sum(axis=1) - 3, 1)
    # The median keeps the deflection itself, which no quadratic follows, out of the noise.
    return slopes, errors, math.sqrt(float(np.median(rest)))


def _deflection(times: Array, signal: Array, name: str, warnings: list[str]) -> tuple[float, float]:
    if signal.shape != times.shape:
        raise UnusableElectrogram(f"The {name} electrogram must have one value for each time.")
    if not np.isfinite(signal).all():
        raise UnusableElectrogram(f"The {name} electrogram holds values that are not numbers.")
    extent = float(np.ptp(signal))
    if not extent > 0:
        raise UnusableElectrogram(f"The {name} electrogram is flat; check the electrode's connection.")
    for rail in (signal.min(), signal.max()):
        at_baseline = abs(rail - np.median(signal)) <= _BASELINE * extent
        if not at_baseline and _clipped(signal, float(rail)):
            raise UnusableElectrogram(f"The {name} electrogram is saturated; lower the amplifier's gain.")
    slopes, errors, noise = local_slope(times, signal)
    inner = slice(2, -2)
    steepest = int(np.argmin(slopes[inner])) + 2
    threshold = _LEAST_SLOPE_TO_NOISE * noise * errors[steepest]
    if not slopes[steepest] < -max(threshold, 1e-9 * extent):
        raise UnusableElectrogram(
            f"The {name} electrogram has no steep negative deflection that stands out from noise."
        )
    rivals = (slopes < _RIVAL * slopes[steepest]) & (np.abs(times - times[steepest]) > _RIVAL_AWAY_MS)
    if rivals[inner].any():
        warnings.append(
            f"The {name} electrogram has two negative deflections of almost equal steepness; check the annotation."
        )
    if steepest <= 3 or steepest >= len(times) - 4:
        warnings.append(
            f"The deflection of the {name} electrogram lies at the edge of the recording; check the window."
        )
    x = times[steepest - 2 : steepest + 3] - times[steepest]
    curve = np.polyfit(x, slopes[steepest - 2 : steepest + 3], 2)
    spacing = float(np.median(np.diff(times)))
    if curve[0] <= 0:
        return float(times[steepest]), 2.0 * spacing
    place = float(np.clip(-curve[1] / (2.0 * curve[0]), x[0], x[-1]))
    # d(slope) / d(time) changes by 2 c per ms at the minimum: an error of the slope's derivative moves it by error / 2 c.
    derivative_error = noise * errors[steepest] * math.sqrt(10.0) / _WINDOW_MS
    sd = math.hypot(derivative_error / (2.0 * float(curve[0])), _PLACEMENT * spacing)
    return float(times[steepest]) + place, sd


def _clipped(signal: Array, rail: float) -> bool:
    """Whether the signal is held at an extreme that it runs into at speed; a smooth plateau is reached slowly."""
    if _longest_hold(signal, rail) < _SATURATED_SAMPLES:
        return False
    held = np.concatenate([[True], signal == rail, [True]])
    arrives = np.flatnonzero(~held[:-2] & held[1:-1])
    leaves = np.flatnonzero(held[1:-1] & ~held[2:])
    steps = [abs(signal[index] - signal[index - 1]) for index in arrives if index >= 1]
    steps += [abs(signal[index + 1] - signal[index]) for index in leaves if index + 1 < len(signal)]
    return bool(steps) and max(steps) > _ABRUPT * np.abs(np.diff(signal)).max()


def _longest_hold(signal: Array, value: float) -> int:
    """Longest run of samples that stay at ``value``."""
    held = np.concatenate([[False], signal == value, [False]])
    edges = np.flatnonzero(np.diff(held.astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max()) if edges.size else 0
