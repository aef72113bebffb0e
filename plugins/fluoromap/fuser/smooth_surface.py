"""The chamber as a smooth wall near the mapping tips, with activation times interpolated along it."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import BaseModel

from fluoromap.contracts import ChamberMap, Context, MappedSite
from fluoromap.fuser.chamber_map import MapParams, chamber_map, refuse_without_volume
from fluoromap.fuser.chamber_shape import wall_surface


class SmoothSurfaceParams(MapParams):
    """Parameters of :class:`SmoothSurface`."""


class SmoothSurface:
    """Fuser ``smooth-surface``: a wall that bulges between sites as chambers do.

    The wall may be concave. Its distance from each site agrees with the site's covariance.
    """

    name: ClassVar[str] = "smooth-surface"
    version: ClassVar[str] = "3"
    Params: ClassVar[type[BaseModel]] = SmoothSurfaceParams

    def __init__(self, params: SmoothSurfaceParams) -> None:
        self._params = params

    def fuse(self, sites: tuple[MappedSite, ...], context: Context) -> ChamberMap:
        """Make surface and map of the located sites; see :func:`fluoromap.fuser.chamber_map.chamber_map`.

        Raises
        ------
        Refusal
            ``too_few_sites`` below four, ``sites_coincide`` or ``sites_coplanar`` where they enclose no volume.
        """
        tips = self._params.tips_mm(sites)
        refuse_without_volume(tips)
        covariance = np.array([site.covariance_mm2 for site in sites])
        surface = wall_surface(tips, covariance, self._params.edge_mm)
        context.progress(0.2)
        return chamber_map(*surface, sites, self._params, context)
