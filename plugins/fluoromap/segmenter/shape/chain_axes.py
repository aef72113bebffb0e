"""Directions along a catheter in the image, and across it."""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array

_TINY_PX = 1e-9


def axes_of_chain(places_uv: Array) -> Array:
    """Return the unit vectors along a catheter and across it at each electrode.

    Parameters
    ----------
    places_uv : (electrodes, 2) float64
        Pixels, in the order of the electrodes, at least two.

    Returns
    -------
    (electrodes, 2, 2) float64
        Electrode, along or across, u and v. Where neighbours lie at one place the catheter counts as horizontal.
    """
    along = np.gradient(places_uv, axis=0)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > _TINY_PX, along / np.maximum(length, _TINY_PX), [1.0, 0.0])
    return np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1)
