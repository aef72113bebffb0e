"""Location of one site: from a matched site to a located one, shared by all triangulators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    APriori,
    Array,
    ElectrodePoint,
    LocatedSite,
    MatchedRuns,
    MatchedSite,
    PhasePair,
    SiteCycle,
)
from fluoromap.reasons import Reason
from fluoromap.triangulator.alternatives import add_alternative
from fluoromap.triangulator.error_sources import (
    ErrorSource,
    bend_source,
    jacobians,
    pixel_noise_px2,
    relative_covariances_mm2,
    site_sources,
    study_sources,
    visible_breathing,
)
from fluoromap.triangulator.estimate import Method
from fluoromap.triangulator.reference_origin import ReferenceOrigin
from fluoromap.triangulator.self_calibration import StudyBelief
from fluoromap.triangulator.site_cycle import CycleMoments, cycle_moments, locate_cycle
from fluoromap.triangulator.site_moment import BUDGET, Diastole, Moment, MomentErrors, errors_in_study
from fluoromap.triangulator.spacing import spacing_mismatches
from fluoromap.triangulator.stray_electrodes import epipolar_rows, widen_strays
from fluoromap.triangulator.table_motion import Jump, jump_source
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels, pixels_in_both_views

FAR_MM = 500.0
"""Largest plausible distance from the isocentre: two views that exceed it do not belong together."""

Notes = tuple[tuple[str, Reason], ...]
"""The notes of a matched site: (catheter, reason)."""


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

    def cameras(self, nominal: Cameras) -> Cameras:
        """Return the cameras of a site as the study shows them, from those of the headers."""
        return self.belief.gantry.cameras(nominal)

    def moments(self, runs: MatchedRuns, cameras: Cameras) -> CycleMoments | None:
        """Return the moments of a site's cycle; None where the views show too few."""
        known = _phase(runs.diastole) is not None
        return cycle_moments(runs.cycle, cameras, self.method) if known else None

    def cycle(self, runs: MatchedRuns, cameras: Cameras, jump: Jump | None, moments: CycleMoments) -> SiteCycle:
        """Locate a site at the moments of its cycle."""
        rest = _phase(runs.diastole)
        assert rest is not None, "the site has moments"
        return locate_cycle(
            moments, rest, cameras, self.catalogue, self.any_study.params, self.method,
            self.any_study.gantry.covariance, jump,
        )  # fmt: skip

    def diastole(
        self, runs: MatchedRuns, cameras: Cameras, jump: Jump | None, moments: CycleMoments | None
    ) -> Diastole:
        """Locate a site at diastole, under both pairings of its catheters."""
        first = self._moment(runs.diastole, cameras, moments, jump)
        other = self._moment(runs.alternative.diastole, cameras, moments, jump) if runs.alternative else None
        shown = runs.diastole.a, runs.diastole.b
        probability = runs.alternative.probability if runs.alternative else 0.0
        phase_known = all(view.phase is not None for view in shown)
        return Diastole(first, other, probability, shown[0].frame, shown[1].frame, phase_known)

    def doubts(self, jump: Jump | None, errors: MomentErrors) -> tuple[Reason, ...]:
        """Return the reasons to doubt all electrodes of a site."""
        is_certain = jump is not None and jump.is_certain
        return tuple(dict.fromkeys(reason for reason, holds in (
            (Reason.TABLE_MOVED, is_certain or self.belief.doubt is Reason.TABLE_MOVED),
            (Reason.GEOMETRY_DOUBTFUL, errors.inflation > 1 or self.belief.doubt is Reason.GEOMETRY_DOUBTFUL),
        ) if holds))  # fmt: skip

    def a_priori(self, notes: Notes, diastole: Diastole, doubts: tuple[Reason, ...]) -> APriori:
        """Return the electrodes of a site with the covariances of any study.

        Parameters
        ----------
        notes : tuple of (str, Reason)
            Of the matched site.
        diastole : Diastole
            From :meth:`diastole`, with electrodes of the chosen pairing.
        doubts : tuple of Reason
            From :meth:`doubts`.
        """
        # The study's origin depends on the other sites.
        alone = self if self.origin is None else replace(self, origin=None)
        moments = [moment for moment in (diastole.chosen, diastole.alternative) if moment is not None]
        errors = errors_in_study(moments, self.any_study)
        return APriori(alone._points(notes, diastole, errors, doubts)[0])

    def locate(
        self, site: MatchedSite, cameras: Cameras, jump: Jump | None, diastole: Diastole, errors: Sequence[MomentErrors],
        a_priori: APriori, cycle: SiteCycle | None,
    ) -> tuple[LocatedSite, SiteErrors]:  # fmt: skip
        """Return a site in 3D and its share in the study's report.

        The covariances contain the errors that the study shows. Of the site only its name and notes are read, so that its runs
        are not decoded.

        Parameters
        ----------
        site : MatchedSite
        cameras : tuple of Camera
            From :meth:`cameras`.
        jump : Jump or None
        diastole : Diastole
            From :meth:`diastole`, with electrodes of the chosen pairing.
        errors : sequence of MomentErrors
            Of the chosen pairing, then of the alternative one where there is one.
        a_priori : APriori
            From :meth:`a_priori`.
        cycle : SiteCycle or None
            From :meth:`cycle`.
        """
        first, own = diastole.chosen, errors[0]
        assert first is not None, "the chosen pairing has electrodes"
        doubts = self.doubts(jump, own)
        points, reference_mm = self._points(site.notes, diastole, errors, doubts)
        reasons = [reason for reason, holds in (
            (Reason.NO_RESTING_CATHETER, self.catalogue.reference is None),
            (Reason.NO_REFERENCE, reference_mm is None),
            (Reason.PHASE_UNKNOWN, not diastole.phase_known),
        ) if holds]  # fmt: skip
        located = LocatedSite(
            site=site.site,
            camera_a=cameras[0],
            camera_b=cameras[1],
            frame_a=diastole.frame_a,
            frame_b=diastole.frame_b,
            points=points,
            reference_mm=reference_mm,
            cycle=cycle,
            reasons=(*reasons, *doubts),
            variation=self.belief.variation,
            a_priori=a_priori,
        )
        is_certain = jump is not None and jump.is_certain
        notes = () if is_certain or own.inflation > 1 else _breathing_note(site.site, first)
        return located, SiteErrors(len(first.labels), own.squares_mm2, notes)

    def _moment(
        self, pair: PhasePair, cameras: Cameras, cycle: CycleMoments | None, jump: Jump | None
    ) -> Moment | None:
        pixels = pixels_in_both_views(pair)
        start = self.method.start(cameras, pixels)
        if not _plausible(start):
            return None
        phase = _phase(pair)
        motion = (
            cycle.motion(np.array(phase), phase, pixels.labels) if cycle is not None and phase is not None else None
        )
        any_study = self.any_study
        of_study = study_sources(
            cameras, start, pixels.labels, self.catalogue, any_study.params, any_study.gantry.covariance
        )
        of_site = [
            *site_sources(cameras, start, pixels.labels, self.catalogue, any_study.params, motion),
            bend_source(jacobians(cameras, start), any_study.params),
        ]
        if jump is not None:
            of_site.append(jump_source(cameras, start, jump))
        if self.method.estimates_breathing:
            pixels = widen_strays(cameras, pixels, start, (*of_study, *of_site))
        noise = pixel_noise_px2(pixels.covariances)
        breathing = visible_breathing(cameras, start, any_study.params)
        weights = noise + breathing.pixels_px2()
        found = self.method.estimate(cameras, pixels, start, weights)
        if not _plausible(found.points_mm):
            return None
        residuals = pixels.residuals_px(cameras, found.points_mm)
        # Epipolar residuals do not depend on the pixels' weights: no displacement of an electrode changes them.
        rows = epipolar_rows(cameras, found.points_mm) if self.method.estimates_breathing else np.zeros((0, len(noise)))
        apart, breathing_mm = rows @ residuals, 0.0
        if self.method.estimates_breathing:
            breathing_mm = float(
                (breathing.covariance @ breathing.effect_px.T @ np.linalg.solve(weights, residuals))[0]
            )
            residuals = residuals - breathing.effect_px[:, 0] * breathing_mm
        effects = np.concatenate([source.effect_px for source in of_study], axis=1)
        own = noise + sum(source.pixels_px2() for source in of_site)
        gain = found.gain
        return Moment(
            pixels.labels, found.points_mm, residuals.reshape(-1, 2, 2), _ray_angles_deg(cameras, pixels), breathing_mm,
            gain @ own @ gain.T, gain @ effects, tuple(share for source in of_study for share in source.shares),
            _squares_mm2(gain, noise, of_site), apart, rows @ own @ rows.T, rows @ effects,
        )  # fmt: skip

    def _points(
        self, notes: Notes, diastole: Diastole, errors: Sequence[MomentErrors], doubts: tuple[Reason, ...]
    ) -> tuple[tuple[ElectrodePoint, ...], Array | None]:
        """Return the electrodes at diastole, and the reference catheter's mean (3,) where that is located."""
        first, other = diastole.chosen, diastole.alternative
        assert first is not None, "the chosen pairing has electrodes"
        points, reference_mm = self._points_of(notes, first, errors[0].joint_mm2, doubts)
        if other is None:
            return points, reference_mm
        others, other_mm = self._points_of(notes, other, errors[1].joint_mm2, doubts)
        shift = None if reference_mm is None or other_mm is None else other_mm - reference_mm
        return add_alternative(points, others, shift, diastole.probability), reference_mm

    def _points_of(
        self, notes: Notes, moment: Moment, joint: Array, site_doubts: tuple[Reason, ...]
    ) -> tuple[tuple[ElectrodePoint, ...], Array | None]:
        """Return the electrodes under one pairing.

        The second value is the reference catheter's mean (3,) where that is located.

        ``joint`` (N, 3, N, 3) is the covariance of all electrodes.
        """
        labels, points = moment.labels, moment.points_mm
        reference = [
            i
            for i, (catheter, electrode) in enumerate(labels)
            if catheter == self.catalogue.reference and (self.origin is None or electrode in self.origin.offsets_mm)
        ]
        reference_mm, added_mm2 = (points[reference].mean(axis=0) if reference else None), np.zeros((3, 3))
        if self.origin is not None and reference:
            by_offsets = self.origin.from_electrodes([labels[i][1] for i in reference], points[reference])
            assert by_offsets is not None, "these electrodes have offsets"
            reference_mm, added_mm2 = by_offsets
        mismatched = spacing_mismatches(points, labels, self.catalogue, self.spacing_limit_mm)
        doubts: dict[str, list[Reason]] = {name: [reason] for name, reason in self.gap_doubts.items()}
        for catheter, reason in notes:
            doubts.setdefault(catheter, []).append(reason)
        relative = None if reference_mm is None else points - reference_mm
        residuals = np.linalg.norm(moment.residuals_px, axis=2).tolist()
        # The electrodes of a catheter have the same reasons, but for their spacings.
        by_catheter = {
            (catheter, mismatch): tuple(dict.fromkeys((*doubts.get(catheter, []), *mismatch, *site_doubts)))
            for catheter in {catheter for catheter, _ in labels}
            for mismatch in ((), (Reason.SPACING_MISMATCH,))
        }
        reasons = [
            by_catheter[catheter, (Reason.SPACING_MISMATCH,) if i in mismatched else ()]
            for i, (catheter, _) in enumerate(labels)
        ]
        relative_mm2 = None if relative is None else relative_covariances_mm2(joint, reference) + added_mm2
        found = ElectrodePoint.of_moment(
            labels, points, np.einsum("iaib->iab", joint), relative, relative_mm2, [(a, b) for a, b in residuals],
            moment.ray_angles_deg.tolist(), reasons,
        )  # fmt: skip
        return found, reference_mm


@dataclass(frozen=True, slots=True)
class SiteErrors:
    """What the report of the study needs to know about a site's location.

    electrodes : number of located electrodes. squares_mm2 : sum of their variances from each source of error, in the order of
    :class:`~fluoromap.contracts.ErrorBudget`.
    """

    electrodes: int
    squares_mm2: tuple[float, ...]
    notes: tuple[str, ...]


def _squares_mm2(gain: Array, noise_px2: Array, sources: Sequence[ErrorSource]) -> tuple[float, ...]:
    """Return the sum of the electrodes' variances from pixel noise and from each source."""
    squares = dict.fromkeys(BUDGET, 0.0)
    squares["pixels"] += float(((gain @ noise_px2) * gain).sum())
    for source in sources:
        (share,) = set(source.shares)
        effect = gain @ source.effect_px
        squares[share] += float(((effect @ source.covariance) * effect).sum())
    return tuple(squares.values())


def _phase(pair: PhasePair) -> float | None:
    """Return the phase of view a, else that of view b."""
    return pair.a.phase if pair.a.phase is not None else pair.b.phase


def _plausible(points_mm: Array) -> bool:
    return bool(np.isfinite(points_mm).all() and np.abs(points_mm).max() < FAR_MM)


def _breathing_note(site: str, moment: Moment) -> tuple[str, ...]:
    apart_mm = 2 * abs(moment.breathing_mm)
    if apart_mm <= 2.0:
        return ()
    return (
        f"{site}: the whole heart is {apart_mm:.0f} mm apart between the two runs (breathing, a moved table or the "
        "gantry's angles). Positions relative to the reference catheter are hardly affected.",
    )


def _ray_angles_deg(cameras: Cameras, pixels: TwoViewPixels) -> Array:
    """Return the angle between each electrode's two rays, folded to 0..90 degrees, shape (N,)."""
    ray_a, ray_b = (camera.rays(uv) for camera, uv in zip(cameras, pixels.pixels, strict=True))
    cosine = np.abs((ray_a * ray_b).sum(axis=1))
    angles: Array = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
    return angles
