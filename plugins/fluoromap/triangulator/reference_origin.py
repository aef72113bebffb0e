"""One origin for all sites of a study, also where a site locates only some electrodes of the reference catheter.

The mean of six of ten electrodes lies millimetres from the mean of all ten. Sites with different means would not fit together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, LocatedSite

_FEW_SITES_SD_MM = 0.7
"""Standard deviation an axis of an electrode's offset from site to site, where too few sites show it."""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceOrigin:
    """Where the reference catheter's electrodes lie from the study's origin.

    offsets_mm : electrode -> (3,) from the mean of these electrodes, averaged over the sites. covariance_mm2 : (3, 3) of one
    electrode's offset from site to site.
    """

    offsets_mm: dict[int, Array]
    covariance_mm2: Array

    def from_electrodes(self, electrodes: Sequence[int], points_mm: Array) -> tuple[Array, Array] | None:
        """Return the origin (3,) by some of the electrodes, and the covariance (3, 3) that their offsets add.

        The offsets of all electrodes add nothing: their mean is the origin. None where none of the electrodes is known.

        Parameters
        ----------
        electrodes : sequence of int
        points_mm : (n, 3)
            Their places, world.
        """
        known = [row for row, electrode in enumerate(electrodes) if electrode in self.offsets_mm]
        if not known:
            return None
        offsets = np.array([self.offsets_mm[electrodes[row]] for row in known])
        # The errors of n of m offsets have a mean whose variance falls with n and vanishes for n = m.
        share = 1.0 / len(known) - 1.0 / max(len(self.offsets_mm), len(known))
        return (points_mm[known] - offsets).mean(axis=0), share * self.covariance_mm2


def usual_electrodes(sites: Sequence[LocatedSite], reference: str) -> tuple[int, ...]:
    """Return the reference's electrodes that most sites locate.

    Of equally frequent sets the larger one.
    """
    sets = Counter(tuple(electrodes) for site in sites if (electrodes := _electrodes(site, reference)))
    return max(sets, key=lambda electrodes: (sets[electrodes], len(electrodes)), default=())


def common_origin(sites: Sequence[LocatedSite], reference: str) -> ReferenceOrigin | None:
    """Return the origin of the study; None without a located reference.

    It is the mean of the electrodes that most sites locate.
    """
    usual = usual_electrodes(sites, reference)
    if not usual:
        return None
    whole = [site for site in sites if tuple(_electrodes(site, reference)) == usual]
    places = np.array([[_place(site, reference, electrode) for electrode in usual] for site in whole])
    offsets = places - places.mean(axis=1, keepdims=True)
    if len(whole) > 2:
        apart = (offsets - offsets.mean(axis=0)).reshape(-1, 3)
        covariance = apart.T @ apart / ((len(whole) - 1) * len(usual))
    else:
        covariance = _FEW_SITES_SD_MM**2 * np.eye(3)
    return ReferenceOrigin(dict(zip(usual, offsets.mean(axis=0), strict=True)), covariance)


def deviates(site: LocatedSite, reference: str, origin: ReferenceOrigin) -> bool:
    """Return whether the site locates other reference electrodes than most."""
    electrodes = _electrodes(site, reference)
    return bool(electrodes) and tuple(electrodes) != tuple(origin.offsets_mm)


def _electrodes(site: LocatedSite, reference: str) -> list[int]:
    return sorted(point.electrode for point in site.points if point.catheter == reference)


def _place(site: LocatedSite, reference: str, electrode: int) -> Array:
    point = site.point(reference, electrode)
    assert point is not None, "the site locates it"
    return point.position_mm
