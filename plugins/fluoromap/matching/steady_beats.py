"""R waves told to the nearest frame, made finer where the heart beats steadily."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array

_LENGTHS = 61
"""Cycle lengths tried."""
_ORDERS = np.arange(1, 7)
"""Harmonics of the catheters' motion; their strength falls as a Gaussian of the order with this rate."""
_FALLING = 0.35
_SCATTER = (0.003, 0.01, 0.03, 0.1)
"""Variances tried of what does not repeat, against those of the motion that does."""
_INDEPENDENT = 2.0
"""Coordinates of catheters that count as independent witnesses of the cycle's length: all follow one heart."""


def steady_beats_ms(told_ms: Array, half_frame_ms: float, times_ms: Array, places: Array | None) -> Array:
    """Times of the R waves of a steady rhythm; as told where no steady rhythm lies within half a frame of each.

    A frame that holds an R wave tells it to half a frame. All beats together tell the length of a steady cycle and where
    it starts more finely, and so do the catheters, which come back to their places after one cycle: the answer is the
    mean over all rhythms that both leave possible.

    Parameters
    ----------
    told_ms : ndarray, shape (b,)
        Times of the frames that hold R waves, rising; two or more.
    times_ms : ndarray, shape (g,)
        Of ``places``.
    places : ndarray, shape (g, k), or None
        Coordinates of the catheters, less their mean.
    """
    number = np.arange(len(told_ms))
    apart = number[1:] - number[0]
    shortest = float(((told_ms[1:] - told_ms[0] - 2 * half_frame_ms) / apart).max())
    longest = float(((told_ms[1:] - told_ms[0] + 2 * half_frame_ms) / apart).min())
    lengths = np.linspace(max(shortest, 1.0), longest, _LENGTHS)
    starts = told_ms - number * lengths[:, None]
    earliest, latest = starts.max(axis=1) - half_frame_ms, starts.min(axis=1) + half_frame_ms
    weights = np.maximum(latest - earliest, 0.0)
    if longest <= shortest or not weights.any():
        return told_ms
    if places is not None:
        evidence = _evidence(times_ms / lengths[:, None], places)
        weights *= np.exp(evidence - evidence[weights > 0].max())
    weights /= weights.sum()
    beats: Array = weights @ ((earliest + latest) / 2) + number * float(weights @ lengths)
    return beats


def _evidence(cycles: Array, places: Array) -> Array:
    """Log likelihoods (n,), but for a constant, that places (g, k) at times counted in cycles (n, g) repeat every cycle."""
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
        # Eigenvalues of waves @ waves.T + scatter: these, and the scatter alone for as many as there are more frames.
        spread = np.maximum(sizes, 0.0) + scatter
        scale = ((places**2).sum() - (shares / spread).sum(axis=1)) / (scatter * places.size)
        log_det = np.log(spread).sum(axis=1) + (frames - sizes.shape[1]) * np.log(scatter)
        found.append(-0.5 * _INDEPENDENT * (frames * np.log(np.maximum(scale, 0.0) + 1e-12) + log_det))
    likeliest: Array = np.max(found, axis=0)
    return likeliest
