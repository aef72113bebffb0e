"""The paper's chamber: the convex hull of the mapping tips, with activation times interpolated along it."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from fluoromap.contracts import ChamberMap, Context, MappedSite
from fluoromap.fuser.chamber_map import MapParams, chamber_map, refuse_without_volume
from fluoromap.fuser.surface import hull_surface, refine


class ConvexHullParams(MapParams):
    """Parameters of :class:`ConvexHull`."""


class ConvexHull:
    """Fuser ``convex-hull``: flat between the outermost sites, so that its volume is smaller than the chamber's."""

    name: ClassVar[str] = "convex-hull"
    version: ClassVar[str] = "4"
    Params: ClassVar[type[BaseModel]] = ConvexHullParams

    def __init__(self, params: ConvexHullParams) -> None:
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
        surface = refine(*hull_surface(tips), self._params.edge_mm)
        context.progress(0.2)
        return chamber_map(*surface, sites, self._params, context)
