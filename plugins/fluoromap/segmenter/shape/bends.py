"""Bends of catheters: how much they turn from gap to gap."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array

BEND_SD, _USUAL_GAP_MM = 0.36, 4.7
"""Standard deviation of a bend between two gaps, radians; in proportion more where both are wider than usual."""
S_BEND, S_BEND_WEIGHT = 0.12, 1.5
"""Turns to both sides from which on a chain has the shape of an S, radians, and how many times as much its bends count then."""


def bend_freedom(spacing_mm: Array) -> Array:
    """Return how much more than usual each bend may be, (gaps - 1,)."""
    return np.maximum(1.0, np.minimum(spacing_mm[:-1], spacing_mm[1:]) / _USUAL_GAP_MM)
