"""What the last two stages store: results that may also be refusals."""

from __future__ import annotations

from dataclasses import dataclass

from fluoromap.contracts import ChamberMap, Track, View
from fluoromap.reasons import Reason


@dataclass(frozen=True, slots=True)
class MapOutcome:
    """A map, or the reason why there is none with a sentence that says what to do."""

    chamber: ChamberMap | None
    refused: Reason | None
    message: str
    reference_mm: tuple[float, float, float] | None
    """Mean of the sites' reference positions: added to the map's coordinates it gives them from the isocentre."""


@dataclass(frozen=True, slots=True)
class FollowedView:
    """One view of a site followed in 3D, or the reason why not."""

    view: View
    track: Track | None
    refused: Reason | None
    message: str


@dataclass(frozen=True, slots=True)
class FollowedSite:
    site: str
    views: tuple[FollowedView, ...]
