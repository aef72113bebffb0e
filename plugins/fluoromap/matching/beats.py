"""Heart beats of a run, detected from the catheters' own motion."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from fluoromap.contracts import Array

IRREGULAR_ABOVE = 0.2
"""Beats are irregular when the longest exceeds the shortest by this share of their mean."""
SHORTEST_BEAT_MS = 280.0
SMOOTH_MS = 25.0
_PROMINENT = 0.4
_ONSET, _UPSTROKE = 0.15, 0.5
_UNLIKE_BELOW = 0.4


def is_irregular(marks_ms: Array) -> bool:
    """Return whether beats that start at these times differ in length.

    Fewer than two whole beats are never irregular.
    """
    lengths = np.diff(marks_ms)
    return len(lengths) >= 2 and float(np.ptp(lengths)) > IRREGULAR_ABOVE * float(lengths.mean())


def cycle_spread(phases: Array) -> float:
    """Return the standard deviation of the cycles' lengths, as a share of their mean.

    It is 0 where fewer than two cycles can be compared.

    Parameters
    ----------
    phases : ndarray, shape (n,)
        Phases of the frames of a run, all known.
    """
    steps = np.diff(phases) % 1.0
    beat = np.cumsum(np.diff(phases) < -0.5)
    rates = [steps[beat == number].mean() for number in np.unique(beat) if (beat == number).sum() > 2]
    return float(np.std(rates, ddof=1) / np.mean(rates)) if len(rates) > 1 else 0.0


def systole_starts_ms(places: Array, step_ms: float) -> Array:
    """Return the times of the starts of systole, from the first place on.

    The result is empty where the motion shows no beats. Once a beat the catheters leave their resting place and return
    to it. Along the direction of the largest motion, the time of a beat is half way up its rise, where the motion is
    steepest. The start of systole lies earlier by the mean difference over the beats.

    Parameters
    ----------
    places : ndarray, shape (g, k)
        Coordinates of the catheters on an even time grid.
    step_ms : float
        Of that grid.
    """
    smooth = gaussian_filter1d(places, max(SMOOTH_MS / step_ms, 0.5), axis=0)
    away = smooth - np.median(smooth, axis=0)
    along = away @ np.linalg.svd(away, full_matrices=False)[2][0]
    # The heart is longer at rest than away from it: the rarer side is systole.
    along = along if along.mean() >= np.median(along) else -along
    low, high = np.percentile(along, [10, 95])
    if high - low <= 0:
        return np.zeros(0)
    # Its import takes half a second: processes that look for no beats do without it.
    from scipy.signal import find_peaks

    # A resting value is appended, so that a beat at the end of the run has a peak too.
    padded = np.append(along, low)
    peaks, _ = find_peaks(padded, prominence=_PROMINENT * (high - low), distance=max(1.0, SHORTEST_BEAT_MS / step_ms))
    halfway, lead = [], []
    for peak in peaks:
        half = _rise(along, int(peak), low + _UPSTROKE * (along[peak] - low))
        onset = _rise(along, int(peak), low + _ONSET * (along[peak] - low))
        if half is not None:
            halfway.append(half * step_ms)
            lead.append(np.nan if onset is None else (half - onset) * step_ms)
    if not np.isfinite(lead).any():
        return np.zeros(0)
    marks = np.array(halfway) - float(np.nanmedian(lead))
    return marks if _repeats(along, marks / step_ms) else np.zeros(0)


def _rise(signal: Array, peak: int, level: float) -> float | None:
    """Return where the signal last rose through ``level`` before ``peak``, in steps."""
    below = np.flatnonzero(signal[:peak] < level)
    if not len(below):
        return None
    last = int(below[-1])
    return last + float((level - signal[last]) / (signal[last + 1] - signal[last]))


def _repeats(signal: Array, marks: Array) -> bool:
    """Return whether the signal repeats after each mark, over the shortest beat.

    Noise does not.
    """
    if len(marks) < 2:
        return False
    after = np.arange(int(np.diff(marks).min()))
    steps = np.arange(len(signal))
    beats = np.array([np.interp(mark + after, steps, signal, left=np.nan, right=np.nan) for mark in marks])
    beats = beats[np.isfinite(beats).sum(axis=1) > len(after) / 2]
    if len(beats) < 2 or len(after) < 3:
        return False
    unlike = np.nanmean(np.nanvar(beats, axis=0))
    return bool(unlike < _UNLIKE_BELOW * np.nanvar(beats))
