"""Distances between a catheter's electrodes, with errors that last through a run."""

from __future__ import annotations

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, ElectrodePoint
from fluoromap.monoplane.gaussian_path import Lengths

LASTING_SD_MM = 0.05
"""Lasting error of a distance that two views saw: both runs locate the electrodes with nearly the same bias."""
CATALOGUE_SD_MM = 0.3
"""Error of a catalogue's distance against the chord in the image: bent shafts, tip centres, wrong descriptions."""
_NEIGHBOUR_SD_MM, _NEXT_BUT_ONE_SD_MM = 0.1, 0.4
"""Change of a distance from frame to frame: between neighbours, and along a shaft that may bend."""


def catheter_lengths(
    catalogue: Catalogue, points: tuple[ElectrodePoint, ...], expected_mm: Array, moments: int, pixel_sd_mm: float
) -> Lengths:
    """Return the lengths between neighbours and next-but-one electrodes of each catheter.

    A length is the distance that two views saw. Its error has two parts. One differs from frame to frame. The other lasts
    through the run, so that many frames do not make it smaller. The catalogue's distance serves where two views saw the
    distance less well than the catalogue states it.

    Parameters
    ----------
    points : tuple of ElectrodePoint
        The m electrodes, located by two views.
    expected_mm : ndarray, shape (n, m, 3)
        Expected positions, world.
    moments : int
        Moments of the cycle at which two views located the electrodes; 1 where only diastole is known.
    pixel_sd_mm : float
        Pixel noise at the isocentre, an axis.
    """
    first, second, lengths, sds, lasting = [], [], [], [], []
    for name in dict.fromkeys(point.catheter for point in points):
        along = catalogue[name].arc_lengths_mm
        own = sorted((point.electrode, index) for index, point in enumerate(points) if point.catheter == name)
        for step in (1, 2):
            for (low, i), (high, j) in zip(own, own[step:], strict=False):
                expected = np.linalg.norm(expected_mm[:, i] - expected_mm[:, j], axis=1)
                angle = np.radians(min(points[i].ray_angle_deg, points[j].ray_angle_deg))
                located_sd = np.sqrt(2 / moments) * pixel_sd_mm / max(float(np.sin(angle)), 0.1)
                sd = float(np.hypot(LASTING_SD_MM, located_sd))
                if sd > CATALOGUE_SD_MM:
                    sd, expected = CATALOGUE_SD_MM, np.full(len(expected), along[high - 1] - along[low - 1])
                neighbours = step == 1 and high == low + 1
                first.append(i)
                second.append(j)
                lengths.append(np.full(len(expected), np.median(expected)) if neighbours else expected)
                sds.append(_NEIGHBOUR_SD_MM if neighbours else _NEXT_BUT_ONE_SD_MM)
                lasting.append(sd)
    columns = np.array(lengths).reshape(len(first), len(expected_mm)).T
    return Lengths(
        np.array(first, dtype=np.int64), np.array(second, dtype=np.int64), columns, np.array(sds), np.array(lasting)
    )
