"""Maximum-likelihood triangulation of a whole study, with self-calibration of the gantry."""

from __future__ import annotations

from typing import ClassVar

from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, MatchedSite, Triangulation
from fluoromap.triangulator.estimate import JointLeastSquares
from fluoromap.triangulator.study_triangulation import calibrate_and_locate
from fluoromap.triangulator.uncertainty import UncertaintyParams


class MaximumLikelihood:
    """Triangulator ``maximum-likelihood``.

    The two runs of a site are taken one after the other. Breathing displaces the whole heart between them, and each
    catheter rests at a slightly different place in another beat. Generalised least squares locates all electrodes of a
    moment together and accounts for these errors and for those of the gantry. Before that, self-calibration compares the
    gantry's angles and isocentre in the headers with the electrodes of the whole study. It corrects them only where the
    electrodes contradict the headers.
    """

    name: ClassVar[str] = "maximum-likelihood"
    version: ClassVar[str] = "10"
    Params: ClassVar[type[BaseModel]] = UncertaintyParams

    def __init__(self, params: UncertaintyParams) -> None:
        self._params = params

    def triangulate(self, sites: tuple[MatchedSite, ...], catalogue: Catalogue, context: Context) -> Triangulation:
        return calibrate_and_locate(sites, catalogue, context, self._params, JointLeastSquares())
