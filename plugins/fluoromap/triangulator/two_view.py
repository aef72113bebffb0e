"""What the triangulators share: from a matched site to a located one, given how to find points from two views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, ElectrodePoint, LocatedSite, MatchedSite, PhasePair
from fluoromap.reasons import Reason
from fluoromap.triangulator.alternatives import with_alternative
from fluoromap.triangulator.estimate import Estimate, Method
from fluoromap.triangulator.self_calibration import GantryBelief
from fluoromap.triangulator.site_cycle import CycleMoments, cycle_moments, locate_cycle
from fluoromap.triangulator.spacing import spacing_mismatches
from fluoromap.triangulator.strays import epipolar_rows, strays_doubted
from fluoromap.triangulator.table_motion import Jump
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels, seen_in_both
from fluoromap.triangulator.uncertainty import (
    ErrorSource,
    UncertaintyParams,
    effect_px,
    error_sources,
    jacobians,
    pixel_noise_px2,
    relative_covariance_mm2,
    seen_breathing,
)

FAR_MM = 500.0
"""No electrode is this far from the isocentre: two views that say so do not belong together."""
DOUBTFUL_BELOW = 1e-5
"""Chance of a misfit as large as a site's below which its geometry is doubted."""


@dataclass(frozen=True, eq=False)
class Locator:
    """Locates the sites of one study.

    wrong_spacings : catheters whose catalogue entry does not fit the study.
    """

    method: Method
    params: UncertaintyParams
    catalogue: Catalogue
    gantry: GantryBelief
    wrong_spacings: frozenset[str] = frozenset()

    def locate(self, site: MatchedSite, jump: Jump | None) -> tuple[LocatedSite, Moment, list[str]] | None:
        """A site in 3D; None where its two views contradict each other altogether.

        Returns
        -------
        tuple
            The site, its diastole for the error budget, and sentences for the report.
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
                points = with_alternative(points, by_label, shift, site.alternative.probability)
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
        pixels = seen_in_both(pair)
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
            sources = (*sources, _jumped(cameras, start, jump))
        if self.method.takes_out_breathing:
            pixels = strays_doubted(cameras, pixels, start, sources)
        noise = pixel_noise_px2(pixels.covariances)
        errors = noise + sum(source.pixels_px2() for source in sources)
        seen = seen_breathing(cameras, start, self.params)
        found = self.method.estimate(cameras, pixels, start, noise + seen.pixels_px2())
        if not _plausible(found.points_mm):
            return None
        residuals = pixels.residuals_px(cameras, found.points_mm)
        breathing_mm, inflation = 0.0, 1.0
        if self.method.takes_out_breathing:
            # Only what no displacement of the electrodes reaches is misfit; the rest hangs on how the pixels are weighted.
            rows = epipolar_rows(cameras, found.points_mm)
            apart, free = rows @ residuals, len(start)
            misfit = float(apart @ np.linalg.solve(rows @ errors @ rows.T, apart))
            gain = seen.covariance @ seen.effect_px.T @ np.linalg.inv(noise + seen.pixels_px2())
            breathing_mm = float((gain @ residuals)[0])
            residuals = residuals - seen.effect_px[:, 0] * breathing_mm
            if chi2.sf(misfit, free) < DOUBTFUL_BELOW:
                inflation = misfit / free
        return Moment(pixels, found, sources, noise, errors, residuals.reshape(-1, 2, 2), breathing_mm, inflation)

    def _points(
        self, site: MatchedSite, moment: Moment, cameras: Cameras
    ) -> tuple[tuple[ElectrodePoint, ...], Array | None]:
        """The electrodes at diastole, and the reference catheter's mean (3,) where that is located."""
        pixels, points = moment.pixels, moment.found.points_mm
        joint = moment.inflation * moment.found.covariance_mm2(moment.errors_px2)
        reference = [i for i, (catheter, _) in enumerate(pixels.labels) if catheter == self.catalogue.reference]
        reference_mm = points[reference].mean(axis=0) if reference else None
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
                relative_covariance_mm2=relative_covariance_mm2(joint, i, reference) if reference else None,
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
    """A site at diastole: N electrodes in 3D and what is unsure about them.

    noise_px2 : (4 N, 4 N) of the pixels alone. errors_px2 : of all there is. residuals_px : (N, 2 views, 2), less a
    displacement of the heart between the runs. breathing_mm : half of that displacement, as far as the views show it.
    inflation : how much larger the misfit is than chance allows; 1 where chance allows it.
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


def _jumped(cameras: Cameras, points_mm: Array, jump: Jump) -> ErrorSource:
    """One view displaced by as much as it was seen to be, in either direction: the truth may lie with the other one."""
    own, none = jump.displacement_mm[:, None], np.zeros((3, 1))
    effect = effect_px(jacobians(cameras, points_mm), *((own, none) if jump.view == "a" else (none, own)))
    return ErrorSource(effect, np.eye(1), ("breathing",))


def _breathing_note(site: str, moment: Moment) -> list[str]:
    apart_mm = 2 * abs(moment.breathing_mm)
    if apart_mm <= 2.0 or moment.inflation > 1:
        return []
    return [
        f"{site}: between its two runs the whole heart stands {apart_mm:.0f} mm apart (breathing, a moved "
        "table or the gantry's angles); positions relative to the reference catheter hardly suffer from it."
    ]


def _ray_angles_deg(cameras: Cameras, pixels: TwoViewPixels) -> Array:
    """Angle between each electrode's two rays, folded to 0..90 degrees, shape (N,)."""
    ray_a, ray_b = (camera.rays(seen) for camera, seen in zip(cameras, pixels.pixels, strict=True))
    cosine = np.abs((ray_a * ray_b).sum(axis=1))
    angles: Array = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
    return angles
