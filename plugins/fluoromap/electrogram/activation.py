"""Local activation time: the steepest negative deflection of the mapping electrogram minus the reference's.

The paper samples 1000 times a second; here the samples may have any times, as long as these ascend.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fluoromap.contracts import Array

_LEAST_SAMPLES = 20
_WINDOW_MS = 5.0
_WIDTHS = 1.25
_WIDER = 1.5
_WIDEST_MS = 12.0
_LEAST_WINDOW = 7
_SATURATED_SAMPLES = 5
_ABRUPT = 0.05
_BASELINE = 0.1
_LEAST_SLOPE_TO_NOISE = 5.0
_RIVAL = 0.8
_PLACEMENT = 0.05
_RIVAL_AWAY_MS = 10.0
_QUARTILE_OF_NORMAL = 0.31863936396437514
"""25th percentile of the absolute value of a standard normal variable."""


class UnusableElectrogram(ValueError):
    """An electrogram without an activation time; the message says why."""


@dataclass(frozen=True, slots=True)
class ElectrogramResult:
    """The activation time of one site.

    lat_ms : mapping minus reference. sd_ms : its standard deviation. reference_ms, mapping_ms : the deflections' times.
    warnings : sentences about points to check.
    """

    lat_ms: float
    sd_ms: float
    reference_ms: float
    mapping_ms: float
    warnings: tuple[str, ...]


def activation_time(time_ms: ArrayLike, reference: ArrayLike, mapping: ArrayLike) -> ElectrogramResult:
    """Return the local activation time of one site from its two electrograms.

    The slope at each sample is that of a cubic fitted to the samples within 5 ms on each side (Savitzky and Golay,
    Anal. Chem. 36 (1964) 1627, for samples at any spacing), which follows a deflection of a few ms. The steepest place
    lies between samples where the cubic's curvature vanishes. The standard deviation follows from two things: the
    sharpness of that minimum, and the curvatures that the same fits have in the quieter parts of the recording. So hum,
    far field and filtered noise count with their real size, and not as independent errors of the samples.

    Parameters
    ----------
    time_ms, reference, mapping : (n,)
        Times, strictly ascending, and the two signals in any unit.

    Raises
    ------
    UnusableElectrogram
        When a signal is too short, not finite, flat, saturated or without a deflection above the noise; or when times
        do not ascend. The message names the signal.
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


def local_cubics(times: Array, signal: Array, window_ms: float) -> Array:
    """Return the coefficients (n, 4) of a cubic fitted round each sample.

    Each fit uses ``window_ms`` on each side. The coefficients are in powers of ms from the sample.
    """
    n = len(times)
    index = np.arange(n)
    first = np.searchsorted(times, times - window_ms - 1e-9)
    last = np.searchsorted(times, times + window_ms + 1e-9)
    # Where samples are sparse, a fit still needs three on each side.
    first = np.minimum(first, np.maximum(index - _LEAST_WINDOW // 2, 0))
    last = np.maximum(last, np.minimum(index + _LEAST_WINDOW // 2 + 1, n))
    column = np.arange(int((last - first).max()))
    sample = first[:, None] + column[None, :]
    used = sample < last[:, None]
    sample = np.minimum(sample, n - 1)
    x = np.where(used, times[sample] - times[:, None], 0.0)
    scale = np.abs(x).max(axis=1, keepdims=True)
    x /= scale
    design = used[..., None] * x[..., None] ** np.arange(4)
    inverse = np.linalg.pinv(np.einsum("nki,nkj->nij", design, design), hermitian=True)
    fitted = np.einsum("nij,nkj,nk->ni", inverse, design, np.where(used, signal[sample], 0.0))
    coefficients: Array = fitted / scale ** np.arange(4)
    return coefficients


def _quiet_sd(values: Array) -> float:
    """Return the standard deviation of the quieter half of a recording.

    It follows from the lower quartile, so that deflections do not count.
    """
    return float(np.percentile(np.abs(values), 25)) / _QUARTILE_OF_NORMAL


def _deflection(times: Array, signal: Array, name: str, warnings: list[str]) -> tuple[float, float]:
    if signal.shape != times.shape:
        raise UnusableElectrogram(f"The {name} electrogram must have one value for each time.")
    if not np.isfinite(signal).all():
        raise UnusableElectrogram(f"The {name} electrogram contains values that are not numbers.")
    extent = float(np.ptp(signal))
    if not extent > 0:
        raise UnusableElectrogram(f"The {name} electrogram is flat; check the electrode's connection.")
    for rail in (signal.min(), signal.max()):
        at_baseline = abs(rail - np.median(signal)) <= _BASELINE * extent
        if not at_baseline and _is_clipped(signal, float(rail)):
            raise UnusableElectrogram(f"The {name} electrogram is saturated; lower the amplifier's gain.")
    cubics = local_cubics(times, signal, _WINDOW_MS)
    slopes = cubics[:, 1]
    inner = slice(3, -3)
    steepest = int(np.argmin(slopes[inner])) + 3
    threshold = _LEAST_SLOPE_TO_NOISE * _quiet_sd(slopes[inner])
    if not slopes[steepest] < -max(threshold, 1e-9 * extent):
        raise UnusableElectrogram(f"The {name} electrogram has no steep negative deflection above the noise.")
    rivals = (slopes < _RIVAL * slopes[steepest]) & (np.abs(times - times[steepest]) > _RIVAL_AWAY_MS)
    if rivals[inner].any():
        warnings.append(
            f"The {name} electrogram has two negative deflections of almost equal steepness; check the annotation."
        )
    if steepest <= 4 or steepest >= len(times) - 5:
        warnings.append(
            f"The deflection of the {name} electrogram lies at the edge of the recording; check the window."
        )
    return _steepest_place(times, signal, steepest, cubics[steepest])


def _steepest_place(times: Array, signal: Array, steepest: int, cubic: Array) -> tuple[float, float]:
    """Return the steepest place near a sample.

    The result is (time, standard deviation). The cubics are as wide as the deflection.
    """
    spacing = float(np.median(np.diff(times)))
    if cubic[3] <= 0:
        return float(times[steepest]), 2.0 * spacing
    # At its steepest place the derivative of a Gaussian of this standard deviation has such a slope and third power.
    width = min(max(_WIDTHS * math.sqrt(-cubic[1] / (2.0 * cubic[3])), _WINDOW_MS), _WIDEST_MS)
    near = np.flatnonzero(np.abs(times - times[steepest]) <= max(_WINDOW_MS, spacing))
    places = []
    for window in (_WIDER * width, width):
        cubics = local_cubics(times, signal, window)
        best = int(near[np.argmin(cubics[near, 1])])
        curvature, sharpness = cubics[best, 2], 3.0 * cubics[best, 3]
        # The steepest of many noisy places looks sharper than it is: assume one standard deviation less.
        sure = sharpness - 3.0 * _quiet_sd(cubics[:, 3])
        if sure <= 0:
            return float(times[best]), 2.0 * spacing
        before, behind = times[max(best - 1, 0)] - times[best], times[min(best + 1, len(times) - 1)] - times[best]
        places.append(float(times[best] + np.clip(-curvature / sharpness, before, behind)))
        noise_sd = _quiet_sd(cubics[:, 2]) / sure
    # Signals under the deflection, above all far field, shift its steepest place, and shift it more for a wider fit.
    drawn = places[0] - places[1]
    return places[1], math.hypot(max(noise_sd, abs(drawn)), _PLACEMENT * spacing)


def _is_clipped(signal: Array, rail: float) -> bool:
    """Return whether the signal stays at an extreme that it reaches at speed.

    A smooth plateau is reached slowly.
    """
    if _longest_hold(signal, rail) < _SATURATED_SAMPLES:
        return False
    held = np.concatenate([[True], signal == rail, [True]])
    arrives = np.flatnonzero(~held[:-2] & held[1:-1])
    leaves = np.flatnonzero(held[1:-1] & ~held[2:])
    steps = [abs(signal[index] - signal[index - 1]) for index in arrives if index >= 1]
    steps += [abs(signal[index + 1] - signal[index]) for index in leaves if index + 1 < len(signal)]
    return bool(steps) and max(steps) > _ABRUPT * np.abs(np.diff(signal)).max()


def _longest_hold(signal: Array, value: float) -> int:
    """Return the longest run of samples that stay at ``value``."""
    held = np.concatenate([[False], signal == value, [False]])
    edges = np.flatnonzero(np.diff(held.astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max()) if edges.size else 0
