"""Triangulation of all sites of a study."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    APriori,
    Array,
    Calibration,
    Context,
    ErrorBudget,
    LocatedSite,
    MatchedRuns,
    MatchedSite,
    RejectedSite,
    SiteCycle,
    StudyVariation,
    Triangulation,
)
from fluoromap.geometry import Camera, ray_angle_deg
from fluoromap.matching.two_view import PARALLEL_BELOW_DEG
from fluoromap.reasons import Reason
from fluoromap.triangulator.beat_scatter import BeatScatter, beat_scatter
from fluoromap.triangulator.error_sources import error_sources, pixel_noise_px2
from fluoromap.triangulator.estimate import Estimate, Method, separate_gain, triangulate_unweighted
from fluoromap.triangulator.gantry_kinds import LARGEST_MULTIPLE
from fluoromap.triangulator.reference_origin import ReferenceOrigin, common_origin, deviates
from fluoromap.triangulator.self_calibration import (
    GantryBelief,
    any_study_belief,
    calibrate,
    header_belief,
    study_belief,
)
from fluoromap.triangulator.site_cycle import NO_CYCLE, CycleMoments
from fluoromap.triangulator.site_locator import SiteErrors, SiteLocator
from fluoromap.triangulator.site_moment import BUDGET, Diastole, Moment, MomentErrors, errors_in_study
from fluoromap.triangulator.spacing import (
    DOUBT_LIMIT_MM,
    NO_GAPS,
    STUDY_LIMIT_MM,
    Gap,
    SiteGaps,
    site_gaps,
    study_gaps,
    wrong_spacings,
)
from fluoromap.triangulator.stray_electrodes import widen_strays
from fluoromap.triangulator.study_equations import CalibrationSite, SiteEquations, gap_labels, site_equations
from fluoromap.triangulator.table_motion import Jump, table_jumps, table_notes
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels, pixels_in_both_views
from fluoromap.triangulator.uncertainty import UncertaintyParams

_SAME_GANTRY_DEG = 3.0
_SAME_BEAT_MS = 200.0
"""Frames of simultaneous runs that are nearer than this show the same beat: half of the shortest beat."""


@dataclass(frozen=True, eq=False)
class SiteLook:
    """The part of a site that the checks of the whole study need.

    points_mm : (N, 3) first points, from nominal cameras. gaps : between them. same_beat : whether the two frames show the same
    beat if the runs began together. scatter : of the beats in its runs. reasons : why the site
    cannot be located; then there are no points. note : a sentence about these reasons, or none. equations : of the site for the
    calibration, with the gantry that the headers state and the gaps of all catheters.
    """

    stored_apart: ClassVar[bool] = True
    """Each look is stored by itself. So the key of the study's checks needs no hash of the content of unchanged sites."""

    site: str
    camera_a: Camera
    camera_b: Camera
    pixels: TwoViewPixels
    points_mm: Array
    gaps: SiteGaps
    same_beat: bool
    scatter: tuple[BeatScatter, ...] = ()
    reasons: tuple[Reason, ...] = ()
    note: str | None = None
    equations: SiteEquations | None = None

    @property
    def cameras(self) -> Cameras:
        return self.camera_a, self.camera_b

    @property
    def for_calibration(self) -> CalibrationSite:
        return CalibrationSite(self.cameras, self.pixels, self.same_beat, self.scatter)


@dataclass(frozen=True, eq=False)
class StudyChecks:
    """All that the sites of a study show together.

    jumps : one entry a site. wrong, contradicted : catheters whose spacings differ from the catalogue's much, or a little.
    same_gantry : indices of the sites that share the gantry's errors. belief : of the gantry and the heart, for these.
    """

    jumps: tuple[Jump | None, ...]
    wrong: tuple[tuple[str, tuple[Gap, ...]], ...]
    contradicted: tuple[tuple[str, tuple[Gap, ...]], ...]
    same_gantry: tuple[int, ...] = ()
    calibration: Calibration | None = None
    gantry: GantryBelief | None = None
    variation: StudyVariation | None = None
    doubt: Reason | None = None


def locate_study(
    sites: Sequence[MatchedSite], catalogue: Catalogue, context: Context, params: UncertaintyParams, method: Method
) -> Triangulation:
    """Locate every site separately.

    Sites whose views are too close together or whose mapping catheter is missing are rejected.
    """
    looks = _looks(sites, catalogue, context, params)
    usable, rejected, notes = _usable_sites(sites, looks)
    header = header_belief(params)
    locator = SiteLocator(method, catalogue, header, any_study_belief(params), params.spacing_limit_mm)
    return _locate_sites(
        [(site, look.cameras, None, locator) for site, look in usable], catalogue, context, rejected, notes, None
    )


def calibrate_and_locate(
    sites: Sequence[MatchedSite], catalogue: Catalogue, context: Context, params: UncertaintyParams, method: Method
) -> Triangulation:
    """Locate every site after checks of the whole study.

    The checks are for moved tables, wrong spacings and a wrong gantry.
    """
    usable, rejected, notes = _usable_sites(sites, _looks(sites, catalogue, context, params))
    looks = tuple(look for _, look in usable)
    found = context.recall(StudyChecks, (looks, catalogue), partial(_check_study, looks, catalogue, params))
    wrong, contradicted = dict(found.wrong), dict(found.contradicted)
    notes += table_notes([look.site for look in looks], found.jumps)
    notes += _spacing_notes(wrong, catalogue) + _contradiction_notes(contradicted)
    if set(wrong) == set(catalogue.names):
        # Catheter names and scale both come from the spacings, so no located position can be trusted.
        reasons = (Reason.SPACING_MISMATCH, Reason.GEOMETRY_DOUBTFUL)
        rejected += [RejectedSite(look.site, reasons) for look in looks]
        return Triangulation((), tuple(rejected), tuple(notes))
    if found.calibration is not None and found.calibration.applied:
        notes.append(_calibration_note(found.calibration))
    if found.doubt is not None:
        notes.append(_doubt_note(found.doubt))
    header = header_belief(params)
    assert found.gantry is not None, "the study was calibrated"
    assert found.variation is not None, "the study was calibrated"
    belief = study_belief(found.gantry, found.variation, params, found.doubt)
    gap_doubts = dict.fromkeys(contradicted, Reason.CATALOGUE_CONTRADICTED) | dict.fromkeys(
        wrong, Reason.SPACING_MISMATCH
    )
    any_study = any_study_belief(params)
    as_calibrated, as_header = (
        SiteLocator(method, catalogue, own, any_study, params.spacing_limit_mm, gap_doubts) for own in (belief, header)
    )
    work = [
        (site, look.cameras, jump, as_calibrated if i in found.same_gantry else as_header)
        for i, ((site, look), jump) in enumerate(zip(usable, found.jumps, strict=True))
    ]
    return _locate_sites(work, catalogue, context, rejected, notes, found.calibration)


def _check_study(looks: Sequence[SiteLook], catalogue: Catalogue, params: UncertaintyParams) -> StudyChecks:
    """Check the study for moved tables and wrong spacings, and calibrate its gantry."""
    resting = frozenset(catalogue.names) - {catalogue.mapping}
    jumps = tuple(table_jumps([(look.cameras, look.pixels, look.points_mm) for look in looks], resting, params))
    of_study = study_gaps([look.gaps for look in looks])
    wrong = wrong_spacings(of_study, STUDY_LIMIT_MM)
    contradicted = {name: gaps for name, gaps in wrong_spacings(of_study, DOUBT_LIMIT_MM).items() if name not in wrong}
    gaps = [tuple((name, tuple(of)) for name, of in each.items()) for each in (wrong, contradicted)]
    if set(wrong) == set(catalogue.names):
        return StudyChecks(jumps, gaps[0], gaps[1])
    same_gantry = _same_gantry(looks)
    is_certain = [jump is not None and jump.is_certain for jump in jumps]
    unmoved = [looks[i] for i in same_gantry if not is_certain[i]]
    # The looks have the equations of all catheters.
    known = [look.equations for look in unmoved if look.equations is not None] if not wrong else None
    calibration, belief = calibrate(
        [look.for_calibration for look in unmoved], catalogue, frozenset(catalogue.names) - set(wrong), params, known
    )
    return StudyChecks(
        jumps, gaps[0], gaps[1], tuple(same_gantry), calibration, belief.gantry, belief.variation, belief.doubt
    )


def _looks(
    sites: Sequence[MatchedSite], catalogue: Catalogue, context: Context, params: UncertaintyParams
) -> list[SiteLook]:
    return [
        context.recall(
            SiteLook, (site.site, site.runs, catalogue), partial(_first_look, site.site, site.runs, catalogue, params)
        )
        for site in sites
    ]


def _usable_sites(
    sites: Sequence[MatchedSite], looks: Sequence[SiteLook]
) -> tuple[list[tuple[MatchedSite, SiteLook]], list[RejectedSite], list[str]]:
    usable = [(site, look) for site, look in zip(sites, looks, strict=True) if not look.reasons]
    rejected = [RejectedSite(look.site, look.reasons) for look in looks if look.reasons]
    return usable, rejected, [look.note for look in looks if look.note is not None]


def _first_look(name: str, runs: MatchedRuns, catalogue: Catalogue, params: UncertaintyParams) -> SiteLook:
    """Locate a site for the checks of the study.

    The result says why a site cannot be located.
    """
    cameras, pixels = (runs.camera_a, runs.camera_b), pixels_in_both_views(runs.diastole)
    nothing = SiteLook(name, *cameras, pixels, np.zeros((0, 3)), NO_GAPS, _same_beat(runs))
    angle = ray_angle_deg(*cameras)
    if angle < PARALLEL_BELOW_DEG:
        note = f"{name}: the views are {angle:.0f} degrees apart; at least 20 are needed."
        return replace(nothing, reasons=(Reason.VIEWS_PARALLEL,), note=note)
    if catalogue.mapping not in pixels.catheters:
        return replace(nothing, reasons=(Reason.CATHETER_NOT_FOUND,))
    points = triangulate_unweighted(cameras, pixels)
    widest = LARGEST_MULTIPLE**2 * params.gantry_covariance()
    sources = error_sources(cameras, points, pixels.labels, catalogue, params, widest, None)
    pixels = widen_strays(cameras, pixels, points, sources)
    alone = Estimate(points, separate_gain(cameras, points))
    between = site_gaps(pixels, points, alone.covariance_mm2(pixel_noise_px2(pixels.covariances)), catalogue)
    look = replace(nothing, pixels=pixels, points_mm=points, gaps=between, scatter=beat_scatter(runs))
    gaps = gap_labels(catalogue, frozenset(catalogue.names))
    return replace(look, equations=site_equations(look.for_calibration, cameras, catalogue, gaps, params))


def _same_beat(runs: MatchedRuns) -> bool:
    """Return True where the diastolic frames show the same beat.

    This holds if both runs began together.
    """
    frame_a, frame_b = runs.diastole.a.frame, runs.diastole.b.frame
    if frame_a >= len(runs.frame_times_a_ms) or frame_b >= len(runs.frame_times_b_ms):
        return False
    return bool(abs(runs.frame_times_a_ms[frame_a] - runs.frame_times_b_ms[frame_b]) < _SAME_BEAT_MS)


_Work = tuple[MatchedSite, Cameras, Jump | None, SiteLocator]


def _locate_sites(
    work: Sequence[_Work],
    catalogue: Catalogue,
    context: Context,
    rejected: list[RejectedSite],
    notes: list[str],
    calibration: Calibration | None,
) -> Triangulation:
    locations: list[_Location] = []
    for index, one in enumerate(work):
        context.check()
        location = _Location(*one, context)
        if location.diastole.chosen is None:
            rejected.append(RejectedSite(one[0].site, (Reason.PAIRING_FAILED,)))
        else:
            locations.append(location)
        context.progress((index + 1) / len(work))
    _compute_errors(locations)
    found = [location.locate(None) for location in locations]
    notes += [note for _, errors in found for note in errors.notes]
    located = _from_one_origin([site for site, _ in found], locations, catalogue)
    return Triangulation(
        tuple(located), tuple(rejected), tuple(notes), calibration, _budget([errors for _, errors in found])
    )


class _Location:
    """The location of one site.

    Its diastole and its cycle depend on its runs and its cameras alone; they are recalled where these did not change. Other sites
    change only the notes and the size of the errors. The reasons and covariances follow from them quickly.
    """

    def __init__(
        self, site: MatchedSite, nominal: Cameras, jump: Jump | None, locator: SiteLocator, context: Context
    ) -> None:
        self._site, self._jump, self._context = site, jump, context
        self.locator = locator
        self._cameras = locator.cameras(nominal)
        self._inputs = (site.runs, jump, locator.catalogue, *self._cameras)
        self.diastole = context.recall(Diastole, self._inputs, self._locate_diastole)
        self._cycle = context.recall(SiteCycle, self._inputs, self._locate_cycle)
        self.errors: list[MomentErrors] = []

    @property
    def moments(self) -> list[Moment]:
        """The site at diastole under the chosen pairing, then under the alternative one."""
        return [moment for moment in (self.diastole.chosen, self.diastole.alternative) if moment is not None]

    def locate(self, origin: ReferenceOrigin | None) -> tuple[LocatedSite, SiteErrors]:
        """Return the site in 3D, see :meth:`SiteLocator.locate`."""
        locator = self.locator if origin is None else replace(self.locator, origin=origin)
        cycle = self._cycle if self._cycle.labels else None
        return locator.locate(
            self._site, self._cameras, self._jump, self.diastole, self.errors, self._a_priori, cycle
        )  # fmt: skip

    @functools.cached_property
    def _a_priori(self) -> APriori:
        doubts = self.locator.doubts(self._jump, self.errors[0])
        notes = self._site.notes
        inputs = (*self._inputs, self.locator.gap_doubts, notes, doubts)
        return self._context.recall(APriori, inputs, lambda: self.locator.a_priori(notes, self.diastole, doubts))

    @functools.cached_property
    def _moments(self) -> CycleMoments | None:
        return self.locator.moments(self._site.runs, self._cameras)

    def _locate_diastole(self) -> Diastole:
        return self.locator.diastole(self._site.runs, self._cameras, self._jump, self._moments)

    def _locate_cycle(self) -> SiteCycle:
        if self._moments is None or self.diastole.chosen is None:
            return NO_CYCLE
        return self.locator.cycle(self._site.runs, self._cameras, self._jump, self._moments)


def _compute_errors(locations: Sequence[_Location]) -> None:
    """Compute the errors of all sites in the study that their locator describes."""
    alike: dict[int, list[_Location]] = {}
    for location in locations:
        alike.setdefault(id(location.locator), []).append(location)
    for of_locator in alike.values():
        moments = [moment for location in of_locator for moment in location.moments]
        errors = iter(errors_in_study(moments, of_locator[0].locator.belief))
        for location in of_locator:
            location.errors = [next(errors) for _ in location.moments]


def _from_one_origin(
    located: Sequence[LocatedSite], locations: Sequence[_Location], catalogue: Catalogue
) -> list[LocatedSite]:
    """Give all sites the same origin.

    Sites that show other electrodes of the reference catheter than most sites do are located again.
    """
    reference = catalogue.reference
    if reference is None or (origin := common_origin(located, reference)) is None:
        return list(located)
    same: list[LocatedSite] = []
    for first, location in zip(located, locations, strict=True):
        same.append(location.locate(origin)[0] if deviates(first, reference, origin) else first)
    return same


def _same_gantry(sites: Sequence[SiteLook]) -> list[int]:
    """Return the indices of the most sites with the same two gantry positions.

    Only such sites share the gantry's errors.
    """
    if not sites:
        return []
    alike = np.ones((len(sites), len(sites)), dtype=np.bool_)
    for view in (0, 1):
        axes = np.array([site.cameras[view].axis_world for site in sites])
        alike &= np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1))) < _SAME_GANTRY_DEG
    return [int(i) for i in np.flatnonzero(alike[np.argmax(alike.sum(axis=1))])]


def _spacing_notes(wrong: Mapping[str, Sequence[Gap]], catalogue: Catalogue) -> list[str]:
    if set(wrong) == set(catalogue.names):
        return [
            "The electrode spacings of every catheter differ from its description. Check the pixel spacing and the source "
            "distances of both runs, then the description of the catheters."
        ]
    return [
        f"The electrode spacings of the catheter {name!r} differ from its description ({_differences(gaps)}), which was "
        "therefore not used to check the gantry. Correct the description."
        for name, gaps in wrong.items()
    ]


def _contradiction_notes(contradicted: Mapping[str, Sequence[Gap]]) -> list[str]:
    return [
        f"The images contradict the description of the catheter {name!r} ({_differences(gaps)}). Check its electrode "
        "spacings and its tip."
        for name, gaps in contradicted.items()
    ]


def _differences(gaps: Sequence[Gap]) -> str:
    return ", ".join(
        f"{gap.first} to {gap.second}: {gap.located_mm:.1f} mm instead of {gap.catalogue_mm:.1f}" for gap in gaps
    )


def _doubt_note(doubt: Reason) -> str:
    if doubt is Reason.TABLE_MOVED:
        return (
            "At all sites the heart is displaced by the same amount between the two views: the table moved between the runs "
            "of view a and those of view b. Send its position with the files, or repeat one view."
        )
    return (
        "The two views of the study contradict each other in a way that no gantry error explains. Check the geometry of both "
        "views."
    )


def _calibration_note(calibration: Calibration) -> str:
    angle, offset = np.linalg.norm(calibration.rotation_deg), np.linalg.norm(calibration.offset_mm)
    return (
        "The two views contradict each other more than pixel noise allows. Self-calibration turned the "
        f"views by {angle:.2f} degrees and shifted them by {offset:.1f} mm against each other. This changed the electrodes' mean "
        f"epipolar distance from {calibration.epipolar_before_px:.1f} to {calibration.epipolar_after_px:.1f} px."
    )


def _budget(sites: Sequence[SiteErrors]) -> ErrorBudget | None:
    """Return the RMS of each source of error over all located electrodes.

    The result is None where no electrode was located.
    """
    count = sum(site.electrodes for site in sites)
    if not count:
        return None
    totals = np.sum([site.squares_mm2 for site in sites], axis=0)
    return ErrorBudget(**{f"{name}_mm": float(np.sqrt(of / count)) for name, of in zip(BUDGET, totals, strict=True)})
