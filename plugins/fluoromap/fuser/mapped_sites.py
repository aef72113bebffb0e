"""Input of a fuser: located sites joined with their activation times."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, LocatedSite, MappedSite, Triangulation
from fluoromap.reasons import Reason


def map_origin(triangulation: Triangulation) -> tuple[float, float, float] | None:
    """Return the mean position of the reference catheter over the sites, mm from the isocentre.

    None where no site locates it.
    """
    references = _references(triangulation)
    if not len(references):
        return None
    x, y, z = references.mean(axis=0).tolist()
    return (x, y, z)


def mapped_sites(
    triangulation: Triangulation, catalogue: Catalogue, times_ms: Mapping[str, tuple[float, float]]
) -> tuple[MappedSite, ...]:
    """Return the mapping tip of every located site with its time.

    Positions are relative to the reference catheter.

    Parameters
    ----------
    triangulation : Triangulation
        Sites in 3D, mm from the isocentre.
    catalogue : Catalogue
        Gives the mapping catheter's name and tip length.
    times_ms : mapping of site to (activation time, standard deviation)
        Both in ms.

    Returns
    -------
    tuple of MappedSite
        In the order of ``triangulation.sites``. A site without a located reference catheter gets the mean reference of the
        other sites; their spread is added to its covariance. Where no site has a reference, the isocentre is the origin.
        Sites without a mapping tip or without a time are left out.
    """
    mapping = catalogue[catalogue.mapping]
    references = _references(triangulation)
    origin = references.mean(axis=0) if len(references) else np.zeros(3)
    spread = np.cov(references.T) if len(references) > 1 else np.zeros((3, 3))
    sites = []
    reasons: tuple[Reason, ...]
    for site in triangulation.sites:
        tip = site.point(mapping.name, 1)
        if tip is None or site.site not in times_ms:
            continue
        if tip.relative_mm is not None and tip.relative_covariance_mm2 is not None:
            position, covariance = tip.relative_mm, tip.relative_covariance_mm2
            reasons = site.doubts_about(catalogue.reference)
        else:
            position, covariance = tip.position_mm - origin, tip.covariance_mm2 + spread
            reasons = (Reason.NO_REFERENCE,)
        reasons = tuple(dict.fromkeys((*site.doubts_about(mapping.name), *reasons)))
        lat_ms, lat_sd_ms = times_ms[site.site]
        sites.append(
            MappedSite(
                site.site, position, covariance, _axis(site, mapping.name), mapping.tip_mm, lat_ms, lat_sd_ms, reasons
            )
        )
    return tuple(sites)


def _references(triangulation: Triangulation) -> Array:
    return np.array([site.reference_mm for site in triangulation.sites if site.reference_mm is not None]).reshape(-1, 3)


def _axis(site: LocatedSite, catheter: str) -> Array:
    """Return the unit vector from electrode 2 to the tip.

    It is zero where electrode 2 was not located, so that the tip is not extended.
    """
    tip, second = site.point(catheter, 1), site.point(catheter, 2)
    if tip is None or second is None:
        return np.zeros(3)
    direction = tip.position_mm - second.position_mm
    length = float(np.linalg.norm(direction))
    return direction / length if length > 0 else np.zeros(3)
