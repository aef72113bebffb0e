"""The data that travels between stages, and the four stage protocols.

Everything here is a frozen dataclass that is validated once when built: an object that exists is valid. Frames are
counted from 0 inside the project (from 1 in files and in the API). Pixels are (u, v) = (column, row), (0, 0) the centre
of the top-left pixel. World points are millimetres along DICOM patient axes (LPS) from the isocentre. Where a name says
``relative``, the mean of the reference catheter's electrodes in the same frames has been subtracted.
"""

from __future__ import annotations

from fluoromap.contracts.arrays import Array, BoolArray, IntArray, frozen
from fluoromap.contracts.context import Context, Refusal, Silent, StageStopped
from fluoromap.contracts.fusion import ChamberMap, ConductionVelocity, MappedSite, SurfaceSite
from fluoromap.contracts.grades import CHI2_95_3D, Grade, grade_of, grade_of_axis, grades_of, largest_semi_axes_mm
from fluoromap.contracts.matching import (
    Alternative,
    MatchedRuns,
    MatchedSite,
    Matching,
    NamedChain,
    Observation,
    PhasePair,
    RejectedSite,
)
from fluoromap.contracts.monoplane import MonoplaneView, StudyShares, Track
from fluoromap.contracts.plugin_kinds import Fuser, MonoplaneSolver, NoParams, Previewer, Segmenter, Triangulator
from fluoromap.contracts.segmentation import (
    Chain,
    FrameChains,
    FrameSource,
    Marks,
    PixelFacts,
    Preview,
    Run,
    Segmentation,
    Shutter,
    View,
)
from fluoromap.contracts.triangulation import (
    APriori,
    Calibration,
    ElectrodePoint,
    ErrorBudget,
    LocatedSite,
    SiteCycle,
    StudyVariation,
    Triangulation,
)

__all__ = [
    "CHI2_95_3D", "APriori", "Alternative", "Array", "BoolArray", "Calibration", "Chain", "ChamberMap",
    "ConductionVelocity", "Context", "ElectrodePoint", "ErrorBudget", "FrameChains", "FrameSource", "Fuser", "Grade",
    "IntArray", "LocatedSite", "MappedSite", "Marks", "MatchedRuns", "MatchedSite", "Matching", "MonoplaneSolver",
    "MonoplaneView", "NamedChain", "NoParams", "Observation", "PhasePair", "PixelFacts", "Preview", "Previewer", "Refusal",
    "RejectedSite", "Run", "Segmentation", "Segmenter", "Shutter", "Silent", "SiteCycle", "StageStopped", "StudyShares",
    "StudyVariation", "SurfaceSite", "Track", "Triangulation", "Triangulator", "View", "frozen", "grade_of",
    "grade_of_axis", "grades_of", "largest_semi_axes_mm",
]  # fmt: skip
