"""Location of one site: from a matched site to a located one, shared by all triangulators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, ElectrodePoint, LocatedSite, MatchedSite, PhasePair, SiteCycle
from fluoromap.reasons import Reason
from fluoromap.triangulator.alternatives import add_alternative
from fluoromap.triangulator.estimate import Estimate, Method
from fluoromap.triangulator.reference_origin import ReferenceOrigin
from fluoromap.triangulator.self_calibration import StudyBelief
from fluoromap.triangulator.site_cycle import CycleMoments, SiteMotion, cycle_moments, locate_cycle
from fluoromap.triangulator.spacing import spacing_mismatches
from fluoromap.triangulator.stray_electrodes import epipolar_rows, widen_strays
from fluoromap.triangulator.table_motion import Jump, jump_source
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels, pixels_in_both_views
from fluoromap.triangulator.uncertainty import (
    ErrorSource,
    Motion,
    error_sources,
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

    belief : of the study. any_study : the belief where no study shows anything. Positions, cycles and a-priori points depend
    on that belief and on the cameras alone, so that a correction at one site changes no other. spacing_limit_mm : electrode
    spacings farther than this from the catalogue's are reported. gap_doubts : catheters whose catalogue entry contradicts the
    study, with the reason. origin : of the study, where sites locate different electrodes of the reference catheter; otherwise
    the mean of a site's own electrodes is its origin.
    """

    method: Method
    catalogue: Catalogue
    belief: StudyBelief
    any_study: StudyBelief
    spacing_limit_mm: float
    gap_doubts: Mapping[str, Reason] = field(default_factory=dict)
    origin: ReferenceOrigin | None = None

    def cameras(self, site: MatchedSite) -> Cameras:
        """Return the cameras of a site as the study shows them."""
        return self.belief.gantry.cameras((site.camera_a, site.camera_b))

    def moments(self, site: MatchedSite) -> CycleMoments | None:
        """Return the moments of a site's cycle; None where the views show too few."""
        known = _phase(site.diastole) is not None
        return cycle_moments(site.cycle, self.cameras(site), self.method) if known else None

    def cycle(self, site: MatchedSite, jump: Jump | None, moments: CycleMoments) -> SiteCycle:
        """Locate a site at the moments of its cycle."""
        rest = _phase(site.diastole)
        assert rest is not None, "the site has moments"
        return locate_cycle(
            moments, rest, self.cameras(site), self.catalogue, self.any_study.params, self.method,
            self.any_study.gantry.covariance, jump,
        )  # fmt: skip

    def locate(
        self, site: MatchedSite, jump: Jump | None, motion: SiteMotion
    ) -> tuple[LocatedSite, Moment, list[str]] | None:
        """Locate a site in 3D.

        Returns
        -------
        tuple or None
            The site without its cycle, its diastole for the error budget, and sentences for the report. None where no plausible
            position agrees with both views.
        """
        cameras = self.cameras(site)
        moment = self._moment(site.diastole, cameras, motion, jump)
        if moment is None:
            return None
        doubts = tuple(dict.fromkeys(reason for reason, holds in (
            (Reason.TABLE_MOVED, (jump is not None and jump.is_certain) or self.belief.doubt is Reason.TABLE_MOVED),
            (Reason.GEOMETRY_DOUBTFUL, moment.inflation > 1 or self.belief.doubt is Reason.GEOMETRY_DOUBTFUL),
        ) if holds))  # fmt: skip
        other = self._moment(site.alternative.diastole, cameras, motion, jump) if site.alternative else None
        points, reference_mm = self._points(site, moment, moment.joint_mm2, cameras, doubts)
        # The study's origin depends on the other sites.
        alone = replace(self, origin=None)
        a_priori, _ = alone._points(site, moment, moment.any_joint_mm2, cameras, doubts)
        if site.alternative is not None and other is not None:
            others, other_mm = self._points(site, other, other.joint_mm2, cameras, doubts)
            any_others, _ = alone._points(site, other, other.any_joint_mm2, cameras, doubts)
            shift = None if reference_mm is None or other_mm is None else other_mm - reference_mm
            p = site.alternative.probability
            points, a_priori = (
                add_alternative(points, others, shift, p),
                add_alternative(a_priori, any_others, shift, p),
            )
        reasons = [reason for reason, holds in (
            (Reason.NO_RESTING_CATHETER, self.catalogue.reference is None),
            (Reason.NO_REFERENCE, reference_mm is None),
            (Reason.PHASE_UNKNOWN, site.diastole.a.phase is None or site.diastole.b.phase is None),
        ) if holds]  # fmt: skip
        answer = LocatedSite(
            site=site.site,
            camera_a=cameras[0],
            camera_b=cameras[1],
            frame_a=site.diastole.a.frame,
            frame_b=site.diastole.b.frame,
            points=points,
            reference_mm=reference_mm,
            cycle=None,
            reasons=(*reasons, *doubts),
            variation=self.belief.variation,
            a_priori=a_priori,
        )
        return answer, moment, [] if jump is not None and jump.is_certain else _breathing_note(site.site, moment)

    def _moment(
        self, pair: PhasePair, cameras: Cameras, site_motion: SiteMotion, jump: Jump | None
    ) -> Moment | None:
        pixels = pixels_in_both_views(pair)
        start = self.method.start(cameras, pixels)
        if not _plausible(start):
            return None
        phase, motion = _phase(pair), None
        if site_motion.labels and phase is not None:
            motion = site_motion.at(np.array(phase), phase, pixels.labels)
        sources, any_sources = (
            self._sources(belief, cameras, start, pixels.labels, motion, jump)
            for belief in (self.belief, self.any_study)
        )
        if self.method.estimates_breathing:
            pixels = widen_strays(cameras, pixels, start, any_sources)
        noise = pixel_noise_px2(pixels.covariances)
        errors, any_errors = (
            noise + sum(source.pixels_px2() for source in own) for own in (sources, any_sources)
        )  # fmt: skip
        breathing = visible_breathing(cameras, start, self.any_study.params)
        found = self.method.estimate(cameras, pixels, start, noise + breathing.pixels_px2())
        if not _plausible(found.points_mm):
            return None
        residuals = pixels.residuals_px(cameras, found.points_mm)
        breathing_mm, inflation, any_inflation = 0.0, 1.0, 1.0
        if self.method.estimates_breathing:
            # Epipolar residuals do not depend on the pixels' weights: no displacement of an electrode changes them.
            rows = epipolar_rows(cameras, found.points_mm)
            inflation, any_inflation = (_inflation(rows, residuals, own) for own in (errors, any_errors))
            gain = breathing.covariance @ breathing.effect_px.T @ np.linalg.inv(noise + breathing.pixels_px2())
            breathing_mm = float((gain @ residuals)[0])
            residuals = residuals - breathing.effect_px[:, 0] * breathing_mm
        return Moment(
            pixels, found, sources, noise, residuals.reshape(-1, 2, 2), breathing_mm, inflation,
            inflation * found.covariance_mm2(errors), any_inflation * found.covariance_mm2(any_errors),
        )  # fmt: skip

    def _sources(
        self, belief: StudyBelief, cameras: Cameras, points_mm: Array, labels: Sequence[tuple[str, int]],
        motion: Motion | None, jump: Jump | None,
    ) -> tuple[ErrorSource, ...]:  # fmt: skip
        sources = error_sources(
            cameras, points_mm, labels, self.catalogue, belief.params, belief.gantry.covariance, motion
        )
        return sources if jump is None else (*sources, jump_source(cameras, points_mm, jump))

    def _points(
        self, site: MatchedSite, moment: Moment, joint: Array, cameras: Cameras, site_doubts: tuple[Reason, ...]
    ) -> tuple[tuple[ElectrodePoint, ...], Array | None]:
        """Return the electrodes at diastole, and the reference catheter's mean (3,) where that is located.

        ``joint`` (N, 3, N, 3) is the covariance of all electrodes.
        """
        pixels, points = moment.pixels, moment.found.points_mm
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
        mismatched = spacing_mismatches(points, pixels.labels, self.catalogue, self.spacing_limit_mm)
        doubts: dict[str, list[Reason]] = {name: [reason] for name, reason in self.gap_doubts.items()}
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
                        *doubts.get(catheter, []), *([Reason.SPACING_MISMATCH] if i in mismatched else []), *site_doubts,
                    ))
                ),
            )
            for i, (catheter, electrode) in enumerate(pixels.labels)
        )  # fmt: skip
        return found, reference_mm


@dataclass(frozen=True, eq=False)
class Moment:
    """A site at diastole: N electrodes in 3D with their sources of error.

    noise_px2 : (4 N, 4 N) covariance from pixel noise. residuals_px : (N, 2 views, 2), without the displacement of the heart
    between the runs. breathing_mm : half of that displacement, as far as the views show it. inflation : misfit over its
    expected value where chance does not explain it, else 1. joint_mm2, any_joint_mm2 : (N, 3, N, 3) covariance of all
    electrodes, in this study and in any study.
    """

    pixels: TwoViewPixels
    found: Estimate
    sources: tuple[ErrorSource, ...]
    noise_px2: Array
    residuals_px: Array
    breathing_mm: float
    inflation: float
    joint_mm2: Array
    any_joint_mm2: Array


def _inflation(rows: Array, residuals_px: Array, errors_px2: Array) -> float:
    """Return the misfit of the epipolar distances over its expected value.

    It is 1 where chance explains the misfit. ``rows`` (N, 4 N) combine the pixels to epipolar distances.
    """
    apart = rows @ residuals_px
    misfit = float(apart @ np.linalg.solve(rows @ errors_px2 @ rows.T, apart))
    return misfit / len(rows) if chi2.sf(misfit, len(rows)) < DOUBTFUL_BELOW else 1.0


def _phase(pair: PhasePair) -> float | None:
    """Return the phase of a pair: that of view a, or where it is unknown that of view b."""
    return pair.a.phase if pair.a.phase is not None else pair.b.phase


def _plausible(points_mm: Array) -> bool:
    return bool(np.isfinite(points_mm).all() and np.abs(points_mm).max() < FAR_MM)


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
