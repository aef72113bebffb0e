"""The noise of a recording, measured where nothing happens."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array

_QUARTILE_OF_NORMAL = 0.31863936396437514
"""25th percentile of the absolute value of a standard normal variable."""


def quiet_sd(values: Array) -> float:
    """Return the standard deviation of the quieter half of a recording.

    It follows from the lower quartile, so that deflections do not count.
    """
    return float(np.percentile(np.abs(values), 25)) / _QUARTILE_OF_NORMAL
