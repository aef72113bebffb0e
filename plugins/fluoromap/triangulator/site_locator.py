"""Location of one site: from a matched site to a located one, shared by all triangulators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, ElectrodePoint, LocatedSite, MatchedSite, PhasePair
from fluoromap.reasons import Reason
from fluoromap.triangulator.alternatives import add_alternative
from fluoromap.triangulator.estimate import Estimate, Method
from fluoromap.triangulator.reference_origin import ReferenceOrigin
from fluoromap.triangulator.self_calibration import GantryBelief
from fluoromap.triangulator.site_cycle import CycleMoments, cycle_moments, locate_cycle
from fluoromap.triangulator.spacing import spacing_mismatches
from fluoromap.triangulator.stray_electrodes import epipolar_rows, widen_strays
from fluoromap.triangulator.table_motion import Jump
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels, pixels_in_both_views
from fluoromap.triangulator.uncertainty import (
    ErrorSource,
    UncertaintyParams,
    effect_px,
    error_sources,
    jacobians,
    pixel_noise_px2,
    relative_covariance_mm2,
    visible_breathing,
)

FAR_MM = 500.0
"""Largest plausible distance from the isocentre: two views that exceed it do not belong together."""
DOUBTFUL_BELOW = 1e-5
"""Probability of a site's misfit by chance below which its geometry is doubted."""


@dataclass(frozen=True, eq=False)
class SiteLocator:
    """The method and assumptions that locate the sites of one study.

    wrong_spacings : catheters whose catalogue entry contradicts the study. origin : of the study, where sites locate different
    electrodes of the reference catheter; otherwise the mean of a site's own electrodes is its origin.
    """

    method: Method
    params: UncertaintyParams
    catalogue: Catalogue
    gantry: GantryBelief
    wrong_spacings: frozenset[str] = frozenset()
    origin: ReferenceOrigin | None = None

    def locate(self, site: MatchedSite, jump: Jump | None) -> tuple[LocatedSite, Moment, list[str]] | None:
        """Locate a site in 3D.

        Returns
        -------
        tuple or None
            The site, its diastole for the error budget, and sentences for the report. None where no plausible position
            agrees with both views.
        """
        cameras = self.gantry.cameras((site.camera_a, site.camera_b))
        rest = site.diastole.a.phase if site.diastole.a.phase is not None else site.diastole.b.phase
        moments = cycle_moments(site.cycle, cameras, self.method) if rest is not None else None
        moment = self._moment(site.diastole, cameras, moments, jump)
        if moment is None:
            return None
        points, reference_mm = self._points(site, moment, cameras)
        if site.alternative is not None:
            other = self._moment(site.alternative.diastole, cameras, moments, jump)
            if other is not None:
                others, other_mm = self._points(site, other, cameras)
                shift = None if reference_mm is None or other_mm is None else other_mm - reference_mm
                by_label = {(point.catheter, point.electrode): point for point in others}
                points = add_alternative(points, by_label, shift, site.alternative.probability)
        cycle = None
        if moments is not None and rest is not None:
            cycle = locate_cycle(
                moments, rest, cameras, self.catalogue, self.params, self.method, self.gantry.covariance
            )
        reasons = [reason for reason, holds in (
            (Reason.NO_REFERENCE, reference_mm is None),
            (Reason.PHASE_UNKNOWN, site.diastole.a.phase is None or site.diastole.b.phase is None),
            (Reason.TABLE_MOVED, jump is not None),
            (Reason.GEOMETRY_DOUBTFUL, moment.inflation > 1),
        ) if holds]  # fmt: skip
        answer = LocatedSite(
            site=site.site,
            camera_a=cameras[0],
            camera_b=cameras[1],
            frame_a=site.diastole.a.frame,
            frame_b=site.diastole.b.frame,
            points=points,
            reference_mm=reference_mm,
            cycle=cycle,
            reasons=tuple(reasons),
        )
        return answer, moment, _breathing_note(site.site, moment) if jump is None else []

    def _moment(
        self, pair: PhasePair, cameras: Cameras, cycle: CycleMoments | None, jump: Jump | None
    ) -> Moment | None:
        pixels = pixels_in_both_views(pair)
        start = self.method.start(cameras, pixels)
        if not _plausible(start):
            return None
        phase = pair.a.phase if pair.a.phase is not None else pair.b.phase
        motion = (
            cycle.motion(np.array(phase), phase, pixels.labels) if cycle is not None and phase is not None else None
        )
        sources = error_sources(
            cameras, start, pixels.labels, self.catalogue, self.params, self.gantry.covariance, motion
        )  # fmt: skip
        if jump is not None:
            sources = (*sources, _jump_source(cameras, start, jump))
        if self.method.estimates_breathing:
            pixels = widen_strays(cameras, pixels, start, sources)
        noise = pixel_noise_px2(pixels.covariances)
        errors = noise + sum(source.pixels_px2() for source in sources)
        breathing = visible_breathing(cameras, start, self.params)
        found = self.method.estimate(cameras, pixels, start, noise + breathing.pixels_px2())
        if not _plausible(found.points_mm):
            return None
        residuals = pixels.residuals_px(cameras, found.points_mm)
        breathing_mm, inflation = 0.0, 1.0
        if self.method.estimates_breathing:
            # Epipolar residuals do not depend on the pixels' weights: no displacement of an electrode changes them.
            rows = epipolar_rows(cameras, found.points_mm)
            apart, free = rows @ residuals, len(start)
            misfit = float(apart @ np.linalg.solve(rows @ errors @ rows.T, apart))
            gain = breathing.covariance @ breathing.effect_px.T @ np.linalg.inv(noise + breathing.pixels_px2())
            breathing_mm = float((gain @ residuals)[0])
            residuals = residuals - breathing.effect_px[:, 0] * breathing_mm
            if chi2.sf(misfit, free) < DOUBTFUL_BELOW:
                inflation = misfit / free
        return Moment(pixels, found, sources, noise, errors, residuals.reshape(-1, 2, 2), breathing_mm, inflation)

    def _points(
        self, site: MatchedSite, moment: Moment, cameras: Cameras
    ) -> tuple[tuple[ElectrodePoint, ...], Array | None]:
        """Return the electrodes at diastole, and the reference catheter's mean (3,) where that is located."""
        pixels, points = moment.pixels, moment.found.points_mm
        joint = moment.inflation * moment.found.covariance_mm2(moment.errors_px2)
        reference = [
            i
            for i, (catheter, electrode) in enumerate(pixels.labels)
            if catheter == self.catalogue.reference and (self.origin is None or electrode in self.origin.offsets_mm)
        ]
        reference_mm, added_mm2 = (points[reference].mean(axis=0) if reference else None), np.zeros((3, 3))
        if self.origin is not None and reference:
            by_offsets = self.origin.from_electrodes([pixels.labels[i][1] for i in reference], points[reference])
            assert by_offsets is not None, "these electrodes have offsets"
            reference_mm, added_mm2 = by_offsets
        mismatched = spacing_mismatches(points, pixels.labels, self.catalogue, self.params.spacing_limit_mm)
        doubts: dict[str, list[Reason]] = {name: [Reason.SPACING_MISMATCH] for name in self.wrong_spacings}
        for catheter, reason in site.notes:
            doubts.setdefault(catheter, []).append(reason)
        angles = _ray_angles_deg(cameras, pixels)
        residuals = np.linalg.norm(moment.residuals_px, axis=2)
        found = tuple(
            ElectrodePoint(
                catheter=catheter,
                electrode=electrode,
                position_mm=points[i],
                covariance_mm2=joint[i, :, i],
                relative_mm=None if reference_mm is None else points[i] - reference_mm,
                relative_covariance_mm2=(
                    relative_covariance_mm2(joint, i, reference) + added_mm2 if reference else None
                ),
                residual_px=(float(residuals[i, 0]), float(residuals[i, 1])),
                ray_angle_deg=float(angles[i]),
                reasons=tuple(
                    dict.fromkeys((
                        *doubts.get(catheter, []), *([Reason.SPACING_MISMATCH] if i in mismatched else []),
                    ))
                ),
            )
            for i, (catheter, electrode) in enumerate(pixels.labels)
        )  # fmt: skip
        return found, reference_mm


@dataclass(frozen=True, eq=False)
class Moment:
    """A site at diastole: N electrodes in 3D with their sources of error.

    noise_px2 : (4 N, 4 N) covariance from pixel noise. errors_px2 : (4 N, 4 N) covariance from all sources.
    residuals_px : (N, 2 views, 2), without the displacement of the heart between the runs. breathing_mm : half of that
    displacement, as far as the views show it. inflation : misfit over its expected value where chance does not explain
    it, else 1.
    """

    pixels: TwoViewPixels
    found: Estimate
    sources: tuple[ErrorSource, ...]
    noise_px2: Array
    errors_px2: Array
    residuals_px: Array
    breathing_mm: float
    inflation: float


def _plausible(points_mm: Array) -> bool:
    return bool(np.isfinite(points_mm).all() and np.abs(points_mm).max() < FAR_MM)


def _jump_source(cameras: Cameras, points_mm: Array, jump: Jump) -> ErrorSource:
    """Return the error source of a jump, in either direction.

    Either view may show the true place.
    """
    own, none = jump.displacement_mm[:, None], np.zeros((3, 1))
    effect = effect_px(jacobians(cameras, points_mm), *((own, none) if jump.view == "a" else (none, own)))
    return ErrorSource(effect, np.eye(1), ("breathing",))


def _breathing_note(site: str, moment: Moment) -> list[str]:
    apart_mm = 2 * abs(moment.breathing_mm)
    if apart_mm <= 2.0 or moment.inflation > 1:
        return []
    return [
        f"{site}: the whole heart is {apart_mm:.0f} mm apart between the two runs (breathing, a moved table or the "
        "gantry's angles). Positions relative to the reference catheter are hardly affected."
    ]


def _ray_angles_deg(cameras: Cameras, pixels: TwoViewPixels) -> Array:
    """Return the angle between each electrode's two rays, folded to 0..90 degrees, shape (N,)."""
    ray_a, ray_b = (camera.rays(uv) for camera, uv in zip(cameras, pixels.pixels, strict=True))
    cosine = np.abs((ray_a * ray_b).sum(axis=1))
    angles: Array = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
    return angles
