"""Refinement of R waves of a steady rhythm, which files give to the nearest frame."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array

_LENGTHS = 61
"""Number of cycle lengths to try."""
_ORDERS = np.arange(1, 7)
"""Harmonics of the catheters' motion; their strength falls as a Gaussian of the order with this rate."""
_FALLING = 0.35
"""The strength of the harmonics of the catheters' motion is a Gaussian of the order with this rate."""
_SCATTER = (0.003, 0.01, 0.03, 0.1)
"""Variances of the motion that does not repeat, over those of the repeating motion, to try."""
_INDEPENDENT = 2.0
"""Number of catheter coordinates that count as independent evidence: all follow one heart."""


def steady_beats_ms(r_waves_ms: Array, half_frame_ms: float, times_ms: Array, places: Array | None) -> Array:
    """Return the times of the R waves of a steady rhythm.

    The times of the file are returned where no steady rhythm lies within half a frame of each. A frame gives its R wave
    to half a frame. All beats together give the length of a steady cycle and its start more precisely. So do the
    catheters, which return to their places after one cycle. The result is the mean over all rhythms that both permit.

    Parameters
    ----------
    r_waves_ms : ndarray, shape (b,)
        Times of the frames that contain R waves, rising; two or more.
    half_frame_ms : float
        Half the time between two frames.
    times_ms : ndarray, shape (g,)
        Of ``places``.
    places : ndarray, shape (g, k), or None
        Coordinates of the catheters, less their mean.
    """
    number = np.arange(len(r_waves_ms))
    apart = number[1:] - number[0]
    shortest = float(((r_waves_ms[1:] - r_waves_ms[0] - 2 * half_frame_ms) / apart).max())
    longest = float(((r_waves_ms[1:] - r_waves_ms[0] + 2 * half_frame_ms) / apart).min())
    lengths = np.linspace(max(shortest, 1.0), longest, _LENGTHS)
    starts = r_waves_ms - number * lengths[:, None]
    earliest, latest = starts.max(axis=1) - half_frame_ms, starts.min(axis=1) + half_frame_ms
    weights = np.maximum(latest - earliest, 0.0)
    if longest <= shortest or not weights.any():
        return r_waves_ms
    if places is not None:
        evidence = _evidence(times_ms / lengths[:, None], places)
        weights *= np.exp(evidence - evidence[weights > 0].max())
    weights /= weights.sum()
    beats: Array = weights @ ((earliest + latest) / 2) + number * float(weights @ lengths)
    return beats


def _evidence(cycles: Array, places: Array) -> Array:
    """Return the log-likelihoods (n,) that the places repeat every cycle.

    They lack a constant. cycles : (n, g), the times in cycles. places : (g, k).
    """
    angle = 2 * np.pi * cycles[:, :, None] * _ORDERS
    strength = np.exp(-0.5 * (_FALLING * _ORDERS) ** 2)
    strength /= np.linalg.norm(strength)
    waves = np.concatenate([np.cos(angle) * strength, np.sin(angle) * strength], axis=2)
    across = waves.transpose(0, 2, 1)
    sizes, axes = np.linalg.eigh(across @ waves)
    shares = ((axes.transpose(0, 2, 1) @ (across @ places)) ** 2).sum(axis=2)
    frames = len(places)
    found = []
    for scatter in _SCATTER:
        # waves @ waves.T + scatter has these eigenvalues, and the scatter alone for each further frame.
        spread = np.maximum(sizes, 0.0) + scatter
        scale = ((places**2).sum() - (shares / spread).sum(axis=1)) / (scatter * places.size)
        log_det = np.log(spread).sum(axis=1) + (frames - sizes.shape[1]) * np.log(scatter)
        found.append(-0.5 * _INDEPENDENT * (frames * np.log(np.maximum(scale, 0.0) + 1e-12) + log_det))
    likeliest: Array = np.max(found, axis=0)
    return likeliest
