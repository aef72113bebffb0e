"""Cardiac phase of a run's frames, from R waves or the catheters' motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from fluoromap.contracts import Array, Segmentation
from fluoromap.matching.beats import SMOOTH_MS, is_irregular, systole_starts_ms
from fluoromap.matching.run_catheters import RunCatheter
from fluoromap.matching.steady_beats import steady_beats_ms

SHORTEST_CYCLE_MS = 300.0
LONGEST_CYCLE_MS = 1600.0
MUST_SHOW = 0.7
"""A catheter is used for timing when it is present in this share of the frames."""
PERIODIC_BELOW = 0.5
"""Limit of the mean squared change over one cycle, as a share of that over any time; a larger change is not periodic."""
_SAME_CYCLE = 0.15
_BINS = 60


@dataclass(frozen=True, eq=False)
class Rhythm:
    """The cardiac cycle in one run.

    phases : (n,) of each frame, 0 at the R wave or at the start of systole, rising to 1 at the next.
    irregular : whether the beats differ in length.
    phase_uncertainty : the largest possible error of phase 0, in cycles. R waves are known to the nearest frame;
    without them phase 0 may lie anywhere.
    """

    phases: Array
    irregular: bool
    phase_uncertainty: float = 0.5


def cardiac_phases(segmentation: Segmentation, catheters: Sequence[RunCatheter]) -> Rhythm | None:
    """Return the phase of each frame, or None where it is unknown.

    - With R waves, the time between two of them is one cycle. Before the first and after the last one the neighbouring
    cycle's
      length is used. The frames give them to half a frame; a steady rhythm gives them more precisely.
    - Without R waves, the length of the cycle is the time after which the catheters are back at their places. Systole
    begins where
      the longest quiet stretch of the cycle ends.
    - Where the catheters show beats that differ in length, each beat counts from its own start of systole.
    """
    times = segmentation.frame_times_ms
    beats = times[np.array(sorted(set(segmentation.r_wave_frames)), dtype=np.intp)]
    if len(beats) < 2 and (len(times) < 8 or np.any(np.diff(times) <= 0)):
        return None
    step_ms = float(np.median(np.diff(times)))
    grid = np.arange(times[0], times[-1] + step_ms / 2, step_ms)
    places = _places(segmentation, catheters, grid)
    if len(beats) >= 2:
        finer = steady_beats_ms(beats, step_ms / 2, grid, places)
        uncertainty = step_ms / 2 / float(np.diff(finer).mean())
        return Rhythm(_phases_from_beats(times, finer), is_irregular(finer), min(uncertainty, 0.5))
    marks = np.zeros(0) if places is None else times[0] + systole_starts_ms(places, step_ms)
    if is_irregular(marks):
        return Rhythm(_phases_from_beats(times, marks), True)
    signal = places if places is not None else np.interp(grid, times, segmentation.motion)[:, None]
    cycle_ms = cycle_length_ms(signal, step_ms)
    if len(marks) >= 2:
        # A lag of two beats repeats as well as a lag of one; the detected beats give their number.
        mean_ms = float(np.polyfit(np.arange(len(marks)), marks, 1)[0])
        if cycle_ms is None or abs(cycle_ms - mean_ms) > _SAME_CYCLE * mean_ms:
            cycle_ms = mean_ms
    if cycle_ms is None:
        return None
    if len(beats) == 1:
        return Rhythm(np.asarray(((times - beats[0]) / cycle_ms) % 1.0), False, min(step_ms / 2 / cycle_ms, 0.5))
    if places is not None:
        smooth = gaussian_filter1d(places, max(SMOOTH_MS / step_ms, 0.5), axis=0)
        speed = np.linalg.norm(np.gradient(smooth, axis=0), axis=1)
    else:
        speed = signal[:, 0]
    start = start_of_systole(((grid - grid[0]) / cycle_ms) % 1.0, speed)
    return Rhythm(np.asarray(((times - grid[0]) / cycle_ms - start) % 1.0), False)


def _phases_from_beats(times: Array, beats: Array) -> Array:
    first, last = beats[1] - beats[0], beats[-1] - beats[-2]
    before = int(np.ceil(max(beats[0] - times[0], 0.0) / first)) + 1
    after = int(np.ceil(max(times[-1] - beats[-1], 0.0) / last)) + 1
    marks = np.concatenate(
        [beats[0] - first * np.arange(before, 0, -1), beats, beats[-1] + last * np.arange(1, after + 1)]
    )
    phases: Array = np.interp(times, marks, np.arange(len(marks), dtype=np.float64)) % 1.0
    return phases


def _places(segmentation: Segmentation, catheters: Sequence[RunCatheter], grid_ms: Array) -> Array | None:
    """Return the centroids of the catheters present nearly throughout, shape (g, 2 k).

    They are on an even time grid, and their drift is removed.
    """
    columns: list[Array] = []
    for catheter in catheters:
        frames, centroids = catheter.centroids_uv
        if len(frames) < MUST_SHOW * len(segmentation.frames):
            continue
        at = segmentation.frame_times_ms[frames]
        columns.extend(np.interp(grid_ms, at, centroids[:, axis]) for axis in (0, 1))
    if not columns:
        return None
    signal = np.stack(columns, axis=1)
    # Breathing within a run is slow: a straight line removes most of it.
    ramp = np.stack([np.ones(len(signal)), np.linspace(-1, 1, len(signal))], axis=1)
    places: Array = signal - ramp @ np.linalg.lstsq(ramp, signal, rcond=None)[0]
    return places


def cycle_length_ms(signal: Array, step_ms: float) -> float | None:
    """Return the length of a signal's cycle.

    The signal (g, k) is on an even time grid. The length is the first lag at which the signal returns to itself nearly
    as well as at its best lag, between 300 and 1600 ms and at most 0.7 of the run. None where the signal does not
    repeat.
    """
    n = len(signal)
    spread = 2.0 * float(signal.var(axis=0).sum())
    lags = np.arange(max(2, int(SHORTEST_CYCLE_MS / step_ms)), int(min(LONGEST_CYCLE_MS / step_ms, 0.7 * n)) + 1)
    if spread <= 0 or len(lags) < 3:
        return None
    change = np.array([float(((signal[lag:] - signal[:-lag]) ** 2).sum(axis=1).mean()) for lag in lags]) / spread
    inner = np.flatnonzero((change[1:-1] <= change[:-2]) & (change[1:-1] <= change[2:])) + 1
    if not len(inner):
        return None
    best = float(change[inner].min())
    if best > PERIODIC_BELOW:
        return None
    found = int(inner[change[inner] <= best + 0.1][0])
    left, middle, right = change[found - 1 : found + 2]
    bend = left - 2 * middle + right
    shift = 0.5 * (left - right) / bend if bend > 0 else 0.0
    return float((lags[found] + shift) * step_ms)


def start_of_systole(phases: Array, speed: Array) -> float:
    """Return the phase at which the longest quiet stretch of the cycle ends.

    The heart also rests at end-systole, but for a shorter time than in diastole.

    Parameters
    ----------
    phases, speed : ndarray, shape (g,)
        Phase from any origin, and the speed of the heart (any unit).
    """
    weights = np.bincount((phases * _BINS).astype(np.intp) % _BINS, minlength=_BINS).astype(np.float64)
    sums = np.bincount((phases * _BINS).astype(np.intp) % _BINS, weights=speed, minlength=_BINS)
    known = np.flatnonzero(weights)
    folded = np.interp(np.arange(_BINS), known, sums[known] / weights[known], period=_BINS)
    folded = gaussian_filter1d(folded, 1.0, mode="wrap")
    threshold = folded.min() + 0.3 * (folded.max() - folded.min())
    # The cycle is cut at its fastest moment, so that no quiet stretch is divided.
    origin = int(np.argmax(folded))
    quiet = np.append(np.roll(folded, -origin) < threshold, False)
    best_length, best_end, length = 0, 0, 0
    for index, still in enumerate(quiet):
        if still:
            length += 1
            continue
        if length > best_length:
            best_length, best_end = length, index
        length = 0
    return float((origin + best_end) % _BINS) / _BINS


def phase_distance(first: Array, second: Array) -> Array:
    """Return the distance between phases round the cycle, 0 to 0.5."""
    apart = np.abs(np.asarray(first) - np.asarray(second)) % 1.0
    distance: Array = np.minimum(apart, 1.0 - apart)
    return distance
