"""Maximum-likelihood triangulation of a whole study, its gantry calibrated by its own electrodes where that is needed."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, MatchedSite, Triangulation
from fluoromap.triangulator.estimate import AllTogether
from fluoromap.triangulator.study_triangulation import calibrate_and_locate
from fluoromap.triangulator.uncertainty import UncertaintyParams


class MaximumLikelihood:
    """Triangulator ``maximum-likelihood``.

    The two runs of a site are taken one after the other, so breathing displaces the whole heart between them, and each
    catheter rests a little elsewhere in another beat. All electrodes of a moment are located together by generalised
    least squares, which knows these errors and those of the gantry. Before that the whole study is asked whether the
    gantry's angles and the isocentre are what the headers say; they are corrected only where the electrodes contradict them.
    """

    name: ClassVar[str] = "maximum-likelihood"
    version: ClassVar[str] = "7"
    Params: ClassVar[type[BaseModel]] = UncertaintyParams

    def __init__(self, params: UncertaintyParams) -> None:
        self._params = params

    def triangulate(self, sites: tuple[MatchedSite, ...], catalogue: Catalogue, context: Context) -> Triangulation:
        return calibrate_and_locate(sites, catalogue, context, self._params, AllTogether())
