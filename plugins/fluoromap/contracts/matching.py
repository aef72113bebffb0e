"""Result of matching: named catheters, paired across the views and by cardiac phase."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fluoromap.contracts.arrays import Array, frozen
from fluoromap.geometry import Camera
from fluoromap.reasons import Reason


@dataclass(frozen=True, eq=False)
class NamedChain:
    """The electrodes of a named catheter in one image.

    Fields as in :class:`Chain`; ``track`` is -1 where the positions are interpolated between frames.
    """

    catheter: str
    electrodes: tuple[int, ...]
    pixels_uv: Array
    covariance_px2: Array
    track: int = -1

    def __post_init__(self) -> None:
        m = len(self.electrodes)
        object.__setattr__(self, "pixels_uv", frozen(self.pixels_uv, (m, 2), "pixels_uv"))
        object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, (m, 2, 2), "covariance_px2"))


@dataclass(frozen=True, slots=True)
class Observation:
    """The named catheters of one view at one moment.

    phase : cardiac phase, 0 to 1 from one R wave, or one start of systole, to the next; None where no cycle is known.
    """

    frame: int
    phase: float | None
    chains: tuple[NamedChain, ...]


@dataclass(frozen=True, slots=True)
class PhasePair:
    """The same cardiac phase in both views, usually of different beats."""

    phase: float | None
    a: Observation
    b: Observation


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another way to pair the catheters of a site across its views.

    probability : 0 to 0.5, that this pairing is the right one.
    """

    diastole: PhasePair
    probability: float

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 0.5:
            raise ValueError(f"the probability of an alternative is {self.probability}; it must lie between 0 and 0.5")


@dataclass(frozen=True, eq=False)
class MatchedRuns:
    """The two runs of a site, with their catheters named in both views.

    diastole : the pair that locates the site. cycle : pairs over the cardiac cycle by rising phase; empty where unknown.
    track_a, track_b : every frame of each run, for tracking in a single view.
    alternative : the next best pairing of the catheters across the views, unless it can be ruled out.
    """

    stored_apart: ClassVar[bool] = True
    """The runs of each site are stored by themselves: a job stores unchanged ones again without decoding them."""

    camera_a: Camera
    camera_b: Camera
    diastole: PhasePair
    cycle: tuple[PhasePair, ...]
    track_a: tuple[Observation, ...]
    track_b: tuple[Observation, ...]
    frame_times_a_ms: Array
    frame_times_b_ms: Array
    alternative: Alternative | None = None


@dataclass(frozen=True, eq=False)
class MatchedSite:
    """One site with its catheters named in both views.

    notes : (catheter, reason) of catheters that are missing or doubtful here. They may change at all sites when a person names a
    catheter at one of them, and then no runs change.
    """

    site: str
    runs: MatchedRuns
    notes: tuple[tuple[str, Reason], ...] = ()


@dataclass(frozen=True, slots=True)
class RejectedSite:
    """A site that could not be located, with the reasons."""

    site: str
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, slots=True)
class Matching:
    """All sites of a study, named and paired, and the rejected ones."""

    sites: tuple[MatchedSite, ...]
    rejected: tuple[RejectedSite, ...]
