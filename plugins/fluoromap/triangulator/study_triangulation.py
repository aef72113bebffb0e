"""Triangulation of all sites of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    Array,
    Calibration,
    Context,
    ErrorBudget,
    LocatedSite,
    MatchedSite,
    RejectedSite,
    Triangulation,
)
from fluoromap.geometry import Camera, ray_angle_deg
from fluoromap.matching.two_view import PARALLEL_BELOW_DEG
from fluoromap.reasons import Reason
from fluoromap.triangulator.estimate import Estimate, Method, separate_gain, triangulate_unweighted
from fluoromap.triangulator.reference_origin import common_origin, deviates
from fluoromap.triangulator.self_calibration import calibrate, header_belief
from fluoromap.triangulator.site_locator import Moment, SiteLocator
from fluoromap.triangulator.spacing import DOUBT_LIMIT_MM, STUDY_LIMIT_MM, WrongGap, wrong_spacings
from fluoromap.triangulator.stray_electrodes import widen_strays
from fluoromap.triangulator.table_motion import Jump, table_jumps, table_notes
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels, pixels_in_both_views
from fluoromap.triangulator.uncertainty import (
    LARGEST_MULTIPLE,
    Share,
    UncertaintyParams,
    error_sources,
    pixel_noise_px2,
)

_SAME_GANTRY_DEG = 3.0


def locate_study(
    sites: Sequence[MatchedSite], catalogue: Catalogue, context: Context, params: UncertaintyParams, method: Method
) -> Triangulation:
    """Locate every site separately.

    Sites whose views are too close together or whose mapping catheter is missing are rejected.
    """
    usable, rejected, notes = _usable_sites(sites, catalogue)
    header = header_belief(params)
    locator = SiteLocator(method, catalogue, header, header, params.spacing_limit_mm)
    return _locate_sites([(site, None, locator) for site in usable], catalogue, context, rejected, notes, None)


def calibrate_and_locate(
    sites: Sequence[MatchedSite], catalogue: Catalogue, context: Context, params: UncertaintyParams, method: Method
) -> Triangulation:
    """Locate every site after checks of the whole study.

    The checks are for moved tables, wrong spacings and a wrong gantry.
    """
    usable, rejected, notes = _usable_sites(sites, catalogue)
    first = [_first_look(site, catalogue, params) for site in usable]
    resting = frozenset(catalogue.names) - {catalogue.mapping}
    jumps = table_jumps([(cameras, pixels, points) for cameras, pixels, points, _ in first], resting, params)
    notes += table_notes([site.site for site in usable], jumps)
    spacings = [(pixels, points, joint) for _, pixels, points, joint in first]
    wrong = wrong_spacings(spacings, catalogue, STUDY_LIMIT_MM)
    contradicted = {
        name: gaps for name, gaps in wrong_spacings(spacings, catalogue, DOUBT_LIMIT_MM).items() if name not in wrong
    }
    notes += _spacing_notes(wrong, catalogue) + _contradiction_notes(contradicted)
    if set(wrong) == set(catalogue.names):
        # Catheter names and scale both come from the spacings, so no located position can be trusted.
        reasons = (Reason.SPACING_MISMATCH, Reason.GEOMETRY_DOUBTFUL)
        rejected += [RejectedSite(site.site, reasons) for site in usable]
        return Triangulation((), tuple(rejected), tuple(notes))
    same_gantry = _same_gantry(usable)
    is_certain = [jump is not None and jump.is_certain for jump in jumps]
    unmoved = [first[i][:2] for i in same_gantry if not is_certain[i]]
    calibration, belief = calibrate(unmoved, catalogue, frozenset(catalogue.names) - set(wrong), params)
    if calibration is not None and calibration.applied:
        notes.append(_calibration_note(calibration))
    if belief.doubt is not None:
        notes.append(_doubt_note(belief.doubt))
    header = header_belief(params)
    gap_doubts = dict.fromkeys(contradicted, Reason.CATALOGUE_CONTRADICTED) | dict.fromkeys(
        wrong, Reason.SPACING_MISMATCH
    )
    work = []
    for i, (site, jump) in enumerate(zip(usable, jumps, strict=True)):
        own = belief if i in same_gantry else header
        work.append((site, jump, SiteLocator(method, catalogue, own, header, params.spacing_limit_mm, gap_doubts)))
    return _locate_sites(work, catalogue, context, rejected, notes, calibration)


def _usable_sites(
    sites: Sequence[MatchedSite], catalogue: Catalogue
) -> tuple[list[MatchedSite], list[RejectedSite], list[str]]:
    usable, rejected, notes = [], [], []
    for site in sites:
        angle = ray_angle_deg(site.camera_a, site.camera_b)
        if angle < PARALLEL_BELOW_DEG:
            rejected.append(RejectedSite(site.site, (Reason.VIEWS_PARALLEL,)))
            notes.append(f"{site.site}: the views are {angle:.0f} degrees apart; at least 20 are needed.")
        elif catalogue.mapping not in pixels_in_both_views(site.diastole).catheters:
            rejected.append(RejectedSite(site.site, (Reason.CATHETER_NOT_FOUND,)))
        else:
            usable.append(site)
    return usable, rejected, notes


def _locate_sites(
    work: Sequence[tuple[MatchedSite, Jump | None, SiteLocator]],
    catalogue: Catalogue,
    context: Context,
    rejected: list[RejectedSite],
    notes: list[str],
    calibration: Calibration | None,
) -> Triangulation:
    located: list[LocatedSite] = []
    moments: list[Moment] = []
    used: list[tuple[MatchedSite, Jump | None, SiteLocator]] = []
    for index, (site, jump, locator) in enumerate(work):
        context.check()
        answer = locator.locate(site, jump)
        if answer is None:
            rejected.append(RejectedSite(site.site, (Reason.PAIRING_FAILED,)))
        else:
            located.append(answer[0])
            used.append((site, jump, locator))
            moments.append(answer[1])
            notes += answer[2]
        context.progress((index + 1) / len(work))
    located = _from_one_origin(located, used, catalogue)
    return Triangulation(tuple(located), tuple(rejected), tuple(notes), calibration, _budget(moments))


def _from_one_origin(
    located: Sequence[LocatedSite],
    work: Sequence[tuple[MatchedSite, Jump | None, SiteLocator]],
    catalogue: Catalogue,
) -> list[LocatedSite]:
    """Give all sites the same origin.

    Sites that show other electrodes of the reference catheter than most sites do are located again.
    """
    origin = common_origin(located, catalogue.reference)
    same: list[LocatedSite] = []
    for first, (site, jump, locator) in zip(located, work, strict=True):
        if origin is not None and deviates(first, catalogue.reference, origin):
            again = replace(locator, origin=origin).locate(site, jump)
            assert again is not None, "the site was located before"
            first = again[0]
        same.append(first)
    return same


def _first_look(
    site: MatchedSite, catalogue: Catalogue, params: UncertaintyParams
) -> tuple[Cameras, TwoViewPixels, Array, Array]:
    """Return a site's nominal cameras, pixels and first points.

    Points (N, 3) in mm, and their covariance (N, 3, N, 3) from pixel noise.
    """
    cameras, pixels = (site.camera_a, site.camera_b), pixels_in_both_views(site.diastole)
    points = triangulate_unweighted(cameras, pixels)
    widest = LARGEST_MULTIPLE**2 * params.gantry_covariance()
    sources = error_sources(cameras, points, pixels.labels, catalogue, params, widest, None)
    pixels = widen_strays(cameras, pixels, points, sources)
    alone = Estimate(points, separate_gain(cameras, points))
    return cameras, pixels, points, alone.covariance_mm2(pixel_noise_px2(pixels.covariances))


def _same_gantry(sites: Sequence[MatchedSite]) -> list[int]:
    """Return the indices of the most sites with the same two gantry positions.

    Only such sites share the gantry's errors.
    """
    best: list[int] = []
    for one in sites:
        alike = [
            i for i, site in enumerate(sites)
            if _angle_deg(one.camera_a, site.camera_a) < _SAME_GANTRY_DEG
            and _angle_deg(one.camera_b, site.camera_b) < _SAME_GANTRY_DEG
        ]  # fmt: skip
        best = max(best, alike, key=len)
    return best


def _angle_deg(first: Camera, second: Camera) -> float:
    return float(np.degrees(np.arccos(np.clip(first.axis_world @ second.axis_world, -1, 1))))


def _spacing_notes(wrong: Mapping[str, Sequence[WrongGap]], catalogue: Catalogue) -> list[str]:
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


def _contradiction_notes(contradicted: Mapping[str, Sequence[WrongGap]]) -> list[str]:
    return [
        f"The images contradict the description of the catheter {name!r} ({_differences(gaps)}). Check its electrode "
        "spacings and its tip."
        for name, gaps in contradicted.items()
    ]


def _differences(gaps: Sequence[WrongGap]) -> str:
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
        "The two views contradict each other more than pixel noise allows. Self-calibration turned view b by "
        f"{angle:.2f} degrees and shifted it by {offset:.1f} mm against its header. This changed the electrodes' mean "
        f"epipolar distance from {calibration.epipolar_before_px:.1f} to {calibration.epipolar_after_px:.1f} px."
    )


def _budget(moments: Sequence[Moment]) -> ErrorBudget | None:
    """Return the RMS of each source of error over all located electrodes.

    The result is None where no electrode was located.
    """
    count = sum(len(moment.found.points_mm) for moment in moments)
    if not count:
        return None
    squares = dict.fromkeys(("pixels", *get_args(Share)), 0.0)
    for moment in moments:
        gain = moment.found.gain
        squares["pixels"] += float(np.trace(gain @ moment.noise_px2 @ gain.T))
        for source in moment.sources:
            for share in set(source.shares):
                of = [k for k, own in enumerate(source.shares) if own == share]
                effect = gain @ source.effect_px[:, of]
                squares[share] += float(np.trace(effect @ source.covariance[np.ix_(of, of)] @ effect.T))
    return ErrorBudget(**{f"{name}_mm": float(np.sqrt(square / count)) for name, square in squares.items()})
