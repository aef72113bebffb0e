"""The paper's triangulation: four linear projection equations for three unknowns."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, MatchedSite, Triangulation
from fluoromap.triangulator.estimate import SeparateLeastSquares
from fluoromap.triangulator.study_triangulation import locate_study
from fluoromap.triangulator.uncertainty import UncertaintyParams


class Linear:
    """Triangulator ``linear``: algebraic least squares of equations (8), each electrode separately."""

    name: ClassVar[str] = "linear"
    version: ClassVar[str] = "8"
    Params: ClassVar[type[BaseModel]] = UncertaintyParams

    def __init__(self, params: UncertaintyParams) -> None:
        self._params = params

    def triangulate(self, sites: tuple[MatchedSite, ...], catalogue: Catalogue, context: Context) -> Triangulation:
        return locate_study(sites, catalogue, context, self._params, SeparateLeastSquares())
