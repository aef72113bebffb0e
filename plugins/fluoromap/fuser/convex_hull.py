"""The paper's chamber: the convex hull of the mapping tips, with activation times interpolated along it."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field
from scipy.spatial import cKDTree
from scipy.special import log_ndtr

from fluoromap.contracts import Array, BoolArray, ChamberMap, Context, MappedSite, Refusal, SurfaceSite
from fluoromap.fuser.surface import (
    SurfacePoints,
    distance_along_surface,
    face_areas_mm2,
    hull_surface,
    nearest_on_surface,
    refine,
    volume_mm3,
)
from fluoromap.fuser.surface_field import LEAST_SD_MS, SurfaceField
from fluoromap.reasons import Reason

LEAST_THICKNESS_MM = 0.5
"""Sites that span less than this across their common plane are one plane: the tips' own position error is as large."""

LEAST_SITES_TO_JUDGE = 8
"""With fewer other sites no activation time can be called an outlier."""

SLOWEST_MM_PER_MS = 0.5
"""A time that a wave as slow as this explains from the nearest other site may be a focus; it is no outlier."""

LEAST_APART_MM = 10.0
"""Nearer sites are judged as if they lay this far apart: 20 ms between neighbours is not yet a wrong annotation."""


class ConvexHullParams(BaseModel, extra="forbid"):
    """Parameters of :class:`ConvexHull`."""

    fill_mm: float = Field(
        15.0,
        ge=1.0,
        le=60.0,
        description="Colour the surface up to this distance from a site, along the surface, in mm.",
    )
    tip_point: Literal["centre", "end"] = Field(
        "centre",
        description="Point of the tip electrode that stands for the wall: its centre, or its end (half a tip further).",
    )
    edge_mm: float = Field(3.0, ge=1.0, le=7.0, description="Longest triangle edge of the refined surface, in mm.")
    outlier_sigma: float = Field(
        5.0,
        ge=3.0,
        le=20.0,
        description="An activation time this many standard deviations from what the other sites predict is kept out, "
        "where conduction at 0.5 m/s from the nearest of them cannot explain it either.",
    )


class ConvexHull:
    """Fuser ``convex-hull``: every site stays in the map, no time is clamped, colour ends where knowledge ends.

    A site inside the hull counts at its nearest point of the surface, and the distance is told. A time that the other
    sites contradict (``outlier_sigma``) keeps its place with the reason ``lat_outlier`` and a warning, but colours
    nothing and counts neither for the earliest sites nor for the total activation time.
    """

    name: ClassVar[str] = "convex-hull"
    version: ClassVar[str] = "1"
    Params: ClassVar[type[BaseModel]] = ConvexHullParams

    def __init__(self, params: ConvexHullParams) -> None:
        self._params = params

    def fuse(self, sites: tuple[MappedSite, ...], context: Context) -> ChamberMap:
        """Surface and activation times of the located sites.

        Raises
        ------
        Refusal
            ``too_few_sites`` below four, ``sites_coplanar`` where they enclose no volume.
        """
        if len(sites) < 4:
            raise Refusal(Reason.TOO_FEW_SITES)
        tips = self._tips_mm(sites)
        if _thickness_mm(tips) < LEAST_THICKNESS_MM:
            raise Refusal(Reason.SITES_COPLANAR)
        lat = np.array([site.lat_ms for site in sites])
        sd = np.array([site.lat_sd_ms for site in sites])

        vertices, faces = refine(*hull_surface(tips), self._params.edge_mm)
        on_surface = nearest_on_surface(vertices, faces, tips)
        context.progress(0.2)
        context.check()
        field = SurfaceField(vertices, faces)
        context.progress(0.5)
        used = self._agreeing(field, on_surface, lat, sd, context)
        kept = _chosen(on_surface, used)

        predicted = np.empty(len(sites))
        predicted[used] = field.leave_one_out(kept, lat[used], sd[used]).predicted_ms
        if not used.all():
            predicted[~used] = field.predict(kept, lat[used], sd[used], _chosen(on_surface, ~used))
        errors = predicted - lat
        context.progress(0.7)
        context.check()
        mean, spread = field.estimate(kept, lat[used], sd[used])
        reach = distance_along_surface(vertices, faces, kept, self._params.fill_mm)
        covered = reach <= self._params.fill_mm
        areas = face_areas_mm2(vertices, faces)
        context.progress(1.0)

        return ChamberMap(
            vertices_mm=vertices,
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
                    lat_ms=site.lat_ms,
                    leave_one_out_error_ms=float(errors[index]),
                    reasons=() if used[index] else (Reason.LAT_OUTLIER,),
                )
                for index, site in enumerate(sites)
            ),
            earliest=earliest_sites(tuple(np.array([site.site for site in sites])[used]), lat[used], sd[used]),
            total_activation_time_ms=float(np.ptp(lat[used])),
            leave_one_out_rms_ms=float(np.sqrt(np.mean(errors[used] ** 2))),
            volume_ml=volume_mm3(vertices, faces) / 1e3,
            area_cm2=float(areas.sum()) / 1e2,
            coverage=float((areas * covered[faces].mean(axis=1)).sum() / areas.sum()),
            warnings=() if used.all() else (Reason.LAT_OUTLIER,),
        )

    def _tips_mm(self, sites: tuple[MappedSite, ...]) -> Array:
        tips = np.array([site.tip_mm for site in sites])
        if self._params.tip_point == "end":
            tips += np.array([site.axis * site.tip_length_mm / 2 for site in sites])
        return tips

    def _agreeing(
        self, field: SurfaceField, points: SurfacePoints, lat: Array, sd: Array, context: Context
    ) -> BoolArray:
        """Which sites (k,) the others do not contradict; the worst goes first, at most a fifth of all."""
        used = np.ones(len(lat), dtype=np.bool_)
        for _ in range(len(lat) // 5):
            context.check()
            if used.sum() <= LEAST_SITES_TO_JUDGE:
                break
            others = field.leave_one_out(_chosen(points, used), lat[used], sd[used])
            error = np.abs(lat[used] - others.predicted_ms)
            apart_mm = np.maximum(_nearest_other_mm(points.positions_mm[used]), LEAST_APART_MM)
            explained = error <= apart_mm / SLOWEST_MM_PER_MS
            deviation = np.where(explained, 0.0, error / others.sd_ms)
            if deviation.max() <= self._params.outlier_sigma:
                break
            used[np.flatnonzero(used)[int(np.argmax(deviation))]] = False
        return used


def earliest_sites(names: tuple[str, ...], lat_ms: Array, lat_sd_ms: Array) -> tuple[tuple[str, float], ...]:
    """Sites that may be the earliest with the probability of each, most probable first, down to 1 %.

    Times are independent and Gaussian: P(i) = integral of p_i(t) times the product over j of P(t_j > t) for j other than i.
    """
    sd = np.maximum(lat_sd_ms, LEAST_SD_MS)[:, None]
    times = np.linspace((lat_ms - 6 * sd[:, 0]).min(), (lat_ms + 6 * sd[:, 0]).min(), 4001)
    z = (times - lat_ms[:, None]) / sd
    log_later = log_ndtr(-z)
    others = log_later.sum(axis=0) - log_later
    share = np.exp(-0.5 * z**2 - np.log(sd) + others).sum(axis=1)
    share /= share.sum()
    order = np.argsort(-share, kind="stable")
    return tuple((str(names[index]), float(share[index])) for index in order if share[index] >= 0.01)


def _chosen(points: SurfacePoints, which: BoolArray) -> SurfacePoints:
    return SurfacePoints(
        points.positions_mm[which], points.faces[which], points.weights[which], points.distance_mm[which]
    )


def _nearest_other_mm(points_mm: Array) -> Array:
    """Straight distance (k,) of each point to the nearest other one."""
    distances = np.asarray(cKDTree(points_mm).query(points_mm, k=2)[0])
    nearest: Array = distances[:, 1]
    return nearest


def _thickness_mm(points_mm: Array) -> float:
    """Extent of the points across the plane that fits them best."""
    centred = points_mm - points_mm.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    return float(np.ptp(centred @ axes[-1]))
