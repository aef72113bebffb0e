"""Loops: circular catheters, whose image is an ellipse."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array
from fluoromap.segmenter.shape.bends import BEND_SD, S_BEND, S_BEND_WEIGHT, bend_freedom

_LOOP_SCALE, _LOOP_SIZE_SD = 1.1, 0.2
_LOOP_TURN_SD, _MOST_UNLIKE_LOOP = 0.9, 3.0
_LEAST_SEEN = 0.1


def off_ellipse(places: Array, angles_rad: Array) -> Array:
    """Return the sums of the squared distances of places from their best ellipses, (n,) pixels².

    The image of a circle is ``c + a cos + b sin`` of the angles on the circle, with the same angles from every side.

    Parameters
    ----------
    places : (n, electrodes, 2)
        Pixels.
    angles_rad : (electrodes,)
        Places on the circle.
    """
    basis = np.linalg.qr(np.column_stack([np.ones(len(angles_rad)), np.cos(angles_rad), np.sin(angles_rad)]))[0]
    centred = places - places.mean(axis=1, keepdims=True)
    on_ellipse = basis.T @ centred
    off: Array = (centred * centred).sum(axis=(1, 2)) - (on_ellipse * on_ellipse).sum(axis=(1, 2))
    return off


def loop_fit(places: Array, spacing_px: Array, curvature_per_mm: float, px_per_mm: float) -> Array:
    """Return how much more likely a loop is than a straight catheter, (n,).

    The image of a circle is an ellipse. A small turn in the image, times the square of the foreshortening there, is the turn on the
    circle times the ratio of the ellipse's axes. That ratio is free where the foreshortening allows it. The size of the circle
    differs from the described one by a fifth. The whole turn is that of the circle from every side; where it is not, an
    unlikeness that is limited counts: seen edge on, the turns have no certain sign. All are 0 without a curvature.
    """
    if not curvature_per_mm:
        return np.zeros(len(places))
    gaps = np.diff(places, axis=1)
    ratios = np.linalg.norm(gaps, axis=2) / spacing_px
    seen = np.minimum(ratios, 1.0)
    u, v = gaps[..., 0], gaps[..., 1]
    turns = np.arctan2(u[:, :-1] * v[:, 1:] - v[:, :-1] * u[:, 1:], (gaps[:, :-1] * gaps[:, 1:]).sum(axis=2))
    freedom = bend_freedom(spacing_px / px_per_mm) ** 2
    shares = np.maximum(seen[:, :-1] * seen[:, 1:], _LEAST_SEEN)
    on_circle = curvature_per_mm / px_per_mm * 0.5 * (spacing_px[:-1] + spacing_px[1:])
    squares, products = (turns * turns * shares / freedom).sum(axis=1), turns @ (on_circle / freedom)
    circle = (on_circle**2 / shares / freedom).sum(axis=1)
    # The mean square of the foreshortening of an ellipse; a loop may be larger than described.
    least = np.sqrt(np.clip(2.0 * (seen * seen).mean(axis=1) / _LOOP_SCALE**2 - 1.0, 0.0, 1.0))
    axes = products / circle
    axes = np.where(axes < 0, -1.0, 1.0) * np.clip(np.abs(axes), least, 1.0)
    left = squares - 2.0 * axes * products + axes * axes * circle
    is_s = (turns.min(axis=1) < -S_BEND) & (turns.max(axis=1) > S_BEND)
    straight = squares * np.where(is_s, S_BEND_WEIGHT * S_BEND_WEIGHT, 1.0)
    unlike = (np.abs(turns.sum(axis=1)) - on_circle.sum()) / _LOOP_TURN_SD
    # The mean square of the foreshortening on an ellipse is that of its axes.
    log_size = 0.5 * np.log(2.0 * (ratios * ratios).mean(axis=1) / (1.0 + axes * axes))
    better: Array = 0.5 * (straight - left) / (BEND_SD * BEND_SD)
    better -= np.minimum(0.5 * unlike * unlike, _MOST_UNLIKE_LOOP)
    better -= 0.5 * (log_size / _LOOP_SIZE_SD) ** 2
    return better
