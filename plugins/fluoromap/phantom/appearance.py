"""Appearance of a view, independent of its angles: photons, scatter, contrast, bones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Contrast = Literal["LAT", "PA"]


@dataclass(frozen=True, slots=True)
class Appearance:
    """Photon budget and attenuation of a view.

    Parameters
    ----------
    photons : float
        Detected photons a pixel, averaged over the image, at dose 1.
    scatter_to_primary : float
        Scattered over primary photons.
    platinum_per_mm : float
        Attenuation of platinum at the view's effective energy.
    shaft : float
        Attenuation across a catheter's shaft through its axis.
    texture : float
        Standard deviation of the soft-tissue texture, in log units.
    spine : bool
        True where vertebrae lie behind the heart.
    """

    photons: float
    scatter_to_primary: float
    platinum_per_mm: float
    shaft: float
    texture: float
    spine: bool


APPEARANCES: dict[Contrast, Appearance] = {
    "LAT": Appearance(500.0, 0.8, 6.0, 0.10, 0.06, spine=False),
    "PA": Appearance(90.0, 3.2, 3.6, 0.08, 0.10, spine=True),
}
"""``LAT`` is the well exposed view, ``PA`` the poor one: few photons, much scatter, a beam hardened by a thick torso."""
