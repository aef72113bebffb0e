"""Input and result of a fuser."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fluoromap.contracts.arrays import Array, BoolArray, IntArray, frozen
from fluoromap.reasons import Reason


@dataclass(frozen=True, eq=False)
class MappedSite:
    """A located site with its activation time: the input of a fuser.

    tip_mm, covariance_mm2 : the mapping tip relative to the reference catheter. axis : (3,) unit vector along the
    catheter from electrode 2 to the tip. tip_length_mm : of the tip electrode. lat_ms, lat_sd_ms : activation time.
    reasons : why the position deserves less trust.
    """

    site: str
    tip_mm: Array
    covariance_mm2: Array
    axis: Array
    tip_length_mm: float
    lat_ms: float
    lat_sd_ms: float
    reasons: tuple[Reason, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "tip_mm", frozen(self.tip_mm, (3,), "tip_mm"))
        object.__setattr__(self, "covariance_mm2", frozen(self.covariance_mm2, (3, 3), "covariance_mm2"))
        object.__setattr__(self, "axis", frozen(self.axis, (3,), "axis"))
        if not (np.isfinite(self.lat_ms) and np.isfinite(self.lat_sd_ms) and self.lat_sd_ms >= 0):
            raise ValueError(
                f"lat_ms {self.lat_ms} and lat_sd_ms {self.lat_sd_ms} must be finite, lat_sd_ms not negative"
            )


@dataclass(frozen=True, eq=False)
class SurfaceSite:
    """A site on the map.

    position_mm : (3,) the site. surface_mm : (3,) its point on the surface. distance_mm : between the two.
    """

    site: str
    position_mm: Array
    surface_mm: Array
    distance_mm: float
    lat_ms: float
    leave_one_out_error_ms: float | None
    reasons: tuple[Reason, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_mm", frozen(self.position_mm, (3,), "position_mm"))
        object.__setattr__(self, "surface_mm", frozen(self.surface_mm, (3,), "surface_mm"))


@dataclass(frozen=True, slots=True)
class ConductionVelocity:
    """Median speed of activation along the wall, with its 95 % interval; metres a second.

    It is measured between sites that lie close together.
    """

    median_m_per_s: float
    low_m_per_s: float
    high_m_per_s: float


@dataclass(frozen=True, eq=False)
class ChamberMap:
    """The chamber's surface with activation times, relative to the reference catheter.

    vertices_mm : (n, 3). faces : (f, 3), outward by the right-hand rule, watertight. lat_ms, lat_sd_ms : (n,), valid where
    ``covered`` (n,); elsewhere no site is near enough and the numbers are 0. earliest : (site, probability), most probable
    first. coverage : covered share of the area, 0..1. conduction_velocity : None where no sites lie close enough.
    cycle_length_ms : of a re-entry: times repeat after it, so that early meets late; None where they do not.
    """

    vertices_mm: Array
    faces: IntArray
    lat_ms: Array
    lat_sd_ms: Array
    covered: BoolArray
    sites: tuple[SurfaceSite, ...]
    earliest: tuple[tuple[str, float], ...]
    total_activation_time_ms: float
    leave_one_out_rms_ms: float | None
    volume_ml: float
    area_cm2: float
    coverage: float
    warnings: tuple[Reason, ...] = field(default=())
    conduction_velocity: ConductionVelocity | None = None
    cycle_length_ms: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices_mm", frozen(self.vertices_mm, (None, 3), "vertices_mm"))
        n = len(self.vertices_mm)
        object.__setattr__(self, "faces", frozen(self.faces, (None, 3), "faces", dtype=np.int64))
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < n):
            raise ValueError(
                f"faces name vertices {self.faces.min()} to {self.faces.max()}, but there are {n} vertices"
            )
        object.__setattr__(self, "lat_ms", frozen(self.lat_ms, (n,), "lat_ms"))
        object.__setattr__(self, "lat_sd_ms", frozen(self.lat_sd_ms, (n,), "lat_sd_ms"))
        object.__setattr__(self, "covered", frozen(self.covered, (n,), "covered", dtype=np.bool_))
