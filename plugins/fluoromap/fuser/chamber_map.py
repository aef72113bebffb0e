"""The chamber's map on a given surface, shared by all fusers."""

from __future__ import annotations

import functools
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field, model_validator

from fluoromap.contracts import Array, BoolArray, ChamberMap, Context, IntArray, MappedSite, Refusal, SurfaceSite
from fluoromap.fuser.activation_times import LEAST_SD_MS, ActivationTimes, LeaveOneOut
from fluoromap.fuser.conduction import conduction_velocity
from fluoromap.fuser.earliest import earliest_sites
from fluoromap.fuser.outlying_times import agreeing_sites
from fluoromap.fuser.reentry_cycle import Cycle
from fluoromap.fuser.surface import (
    SurfacePoints,
    distance_along_surface,
    face_areas_mm2,
    face_normals,
    nearest_on_surface,
    volume_mm3,
)
from fluoromap.fuser.surface_field import SurfaceField
from fluoromap.reasons import AT_BEST_C, Reason

LEAST_EXTENT_MM = 2.0
"""Sites that all lie within this distance of their mean coincide: the position error of the tips is as large."""

LEAST_THICKNESS_MM = 0.5
"""Sites that span less than this across their common plane are coplanar."""

LEAST_SPAN_MS = 1.0
"""Times that span less than this, one sample at 1000 samples/s, are equal."""


class MapParams(BaseModel, extra="forbid"):
    """Parameters of every built-in fuser."""

    fill_mm: float = Field(
        15.0,
        ge=1.0,
        le=60.0,
        description="Colour the surface up to this distance from a site, along the surface, in mm.",
    )
    tip_point: Literal["centre", "end"] = Field(
        "centre",
        description="Point of the tip electrode that touches the wall: its centre, or its end (half a tip further).",
    )
    edge_mm: float = Field(3.0, ge=1.0, le=7.0, description="Longest triangle edge of the surface, about, in mm.")
    outlier_sigma: float = Field(
        5.0,
        ge=3.0,
        le=20.0,
        description="An activation time this many standard deviations from the other sites' prediction is an outlier, "
        "unless conduction at 0.5 m/s from the nearest of them explains it.",
    )
    cycle_length_ms: float | None = Field(
        None,
        ge=50.0,
        le=2000.0,
        description="Cycle length of a re-entry, in ms: times repeat after it and early meets late. Without it times "
        "do not repeat.",
    )
    window_start_ms: float | None = Field(
        None,
        ge=-2000.0,
        le=2000.0,
        description="Start of the window of interest, one cycle long, in ms; half a cycle before the reference where "
        "not given. Times outside are moved into the window by whole cycles. Needs cycle_length_ms.",
    )

    @model_validator(mode="after")
    def _check_window_has_cycle(self) -> MapParams:
        if self.window_start_ms is not None and self.cycle_length_ms is None:
            raise ValueError("window_start_ms is given without cycle_length_ms; give both or neither")
        return self

    @property
    def cycle(self) -> Cycle | None:
        """Cycle of the re-entry with its window of interest, None without one."""
        if self.cycle_length_ms is None:
            return None
        start = self.window_start_ms
        return Cycle(self.cycle_length_ms, -self.cycle_length_ms / 2 if start is None else start)

    def tips_mm(self, sites: tuple[MappedSite, ...]) -> Array:
        """Return the points (k, 3) that touch the wall, in the sites' frame, mm."""
        tips = np.array([site.tip_mm for site in sites])
        if self.tip_point == "end":
            tips += np.array([site.axis * site.tip_length_mm / 2 for site in sites])
        return tips


def refuse_without_volume(tips_mm: Array) -> None:
    """Raise Refusal where points (k, 3), mm, cannot enclose a chamber.

    Raises
    ------
    Refusal
        ``too_few_sites`` below four, ``sites_coincide`` in one place, ``sites_coplanar`` in one plane.
    """
    if len(tips_mm) < 4:
        raise Refusal(Reason.TOO_FEW_SITES)
    centred = tips_mm - tips_mm.mean(axis=0)
    if np.linalg.norm(centred, axis=1).max() < LEAST_EXTENT_MM:
        raise Refusal(Reason.SITES_COINCIDE)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    if np.ptp(centred @ axes[-1]) < LEAST_THICKNESS_MM:
        raise Refusal(Reason.SITES_COPLANAR)


def chamber_map(
    vertices_mm: Array, faces: IntArray, sites: tuple[MappedSite, ...], params: MapParams, context: Context
) -> ChamberMap:
    """Make the map of ``sites`` on a closed outward surface (n, 3), (f, 3) in their frame.

    Every site stays in the map, at the nearest point of the surface; the map holds its distance. A time that the other
    sites contradict stays too, with the reason ``lat_outlier``. It colours nothing and counts neither for the earliest
    sites nor for the total activation time. No time is clamped.
    """
    tips, cycle = params.tips_mm(sites), params.cycle
    measured = np.array([site.lat_ms for site in sites])
    sd = np.array([site.lat_sd_ms for site in sites])
    covariance = np.array([site.covariance_mm2 for site in sites])
    lat = measured if cycle is None else cycle.into_window(measured)
    outside = np.zeros(len(sites), dtype=np.bool_) if cycle is None else cycle.outside(measured)
    difference = np.subtract if cycle is None else cycle.difference

    on_surface = nearest_on_surface(vertices_mm, faces, tips)
    context.check()
    field = SurfaceField(vertices_mm, faces)
    context.progress(0.5)

    @functools.cache
    def times_of_sites(used: tuple[bool, ...]) -> ActivationTimes:
        context.check()
        of = np.array(used)
        return ActivationTimes(field, vertices_mm, _select(on_surface, of), lat[of], sd[of], covariance[of], cycle)

    def times_of(used: BoolArray) -> ActivationTimes:
        return times_of_sites(tuple(used.tolist()))

    def without_each(used: BoolArray) -> LeaveOneOut:
        return times_of(used).leave_one_out()

    used = agreeing_sites(on_surface.positions_mm, lat, params.outlier_sigma, difference, without_each)
    times, used_points = times_of(used), _select(on_surface, used)
    predicted = np.empty(len(sites))
    predicted[used] = times.leave_one_out().predicted_ms
    predicted[~used] = times.at(_select(on_surface, ~used))
    errors = difference(predicted, lat)
    context.progress(0.7)
    context.check()
    mean, spread = times.at_vertices()
    covered = distance_along_surface(vertices_mm, faces, used_points, params.fill_mm) <= params.fill_mm
    areas = face_areas_mm2(vertices_mm, faces)
    normals = face_normals(vertices_mm, faces)[used_points.faces]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    equal = bool(np.ptp(lat[used]) < LEAST_SPAN_MS)
    velocity = None
    if not equal:
        velocity = conduction_velocity(used_points.positions_mm, normals, lat[used], times.sd_ms, difference)
    warnings = {Reason.LAT_OUTLIER: not used.all(), Reason.OUTSIDE_WINDOW: outside.any(), Reason.TIMES_EQUAL: equal}
    doubts = dict.fromkeys(reason for site in sites for reason in site.reasons if reason in AT_BEST_C)
    context.progress(1.0)

    return ChamberMap(
        vertices_mm=vertices_mm,
        faces=faces,
        lat_ms=np.where(covered, mean, 0.0),
        lat_sd_ms=np.where(covered, spread, 0.0),
        covered=covered,
        sites=tuple(
            SurfaceSite(
                site=site.site,
                position_mm=tips[index],
                surface_mm=on_surface.positions_mm[index],
                distance_mm=float(on_surface.distance_mm[index]),
                lat_ms=float(lat[index]),
                leave_one_out_error_ms=float(errors[index]),
                reasons=(
                    *site.reasons,
                    *(() if used[index] else (Reason.LAT_OUTLIER,)),
                    *((Reason.OUTSIDE_WINDOW,) if outside[index] else ()),
                ),
            )
            for index, site in enumerate(sites)
        ),
        earliest=earliest_sites(
            tuple(np.array([site.site for site in sites])[used]), lat[used], np.maximum(sd[used], LEAST_SD_MS)
        ),
        total_activation_time_ms=float(np.ptp(lat[used])),
        leave_one_out_rms_ms=float(np.sqrt(np.mean(errors[used] ** 2))),
        volume_ml=volume_mm3(vertices_mm, faces) / 1e3,
        area_cm2=float(areas.sum()) / 1e2,
        coverage=float((areas * covered[faces].mean(axis=1)).sum() / areas.sum()),
        warnings=(*(reason for reason, holds in warnings.items() if holds), *doubts),
        conduction_velocity=velocity,
        cycle_length_ms=params.cycle_length_ms,
    )


def _select(points: SurfacePoints, which: BoolArray) -> SurfacePoints:
    return SurfacePoints(
        points.positions_mm[which], points.faces[which], points.weights[which], points.distance_mm[which]
    )
