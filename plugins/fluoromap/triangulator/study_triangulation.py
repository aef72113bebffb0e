"""All sites of a study in 3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from fluoromap.triangulator.estimate import Estimate, Method, alone_gain, triangulate_maximum_likelihood
from fluoromap.triangulator.self_calibration import GANTRY_PRIOR, GantryBelief, calibrate
from fluoromap.triangulator.spacing import WrongGap, wrong_spacings
from fluoromap.triangulator.strays import strays_doubted
from fluoromap.triangulator.table_motion import Jump, table_jumps, table_notes
from fluoromap.triangulator.two_view import Locator, Moment
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels, seen_in_both
from fluoromap.triangulator.uncertainty import Share, UncertaintyParams, error_sources, pixel_noise_px2

_SAME_GANTRY_DEG = 3.0


def locate_study(
    sites: Sequence[MatchedSite], catalogue: Catalogue, context: Context, params: UncertaintyParams, method: Method
) -> Triangulation:
    """Locate every site on its own; those whose views are too close or whose mapping catheter is missing are rejected."""
    usable, rejected, notes = _usable(sites, catalogue)
    locator = Locator(method, params, catalogue, GantryBelief(np.eye(4), params.gantry_covariance()))
    return _located([(site, None, locator) for site in usable], context, rejected, notes, None)


def calibrate_and_locate(
    sites: Sequence[MatchedSite], catalogue: Catalogue, context: Context, params: UncertaintyParams, method: Method
) -> Triangulation:
    """As :func:`locate_study`, after asking the whole study for moved tables, wrong spacings and a wrong gantry."""
    usable, rejected, notes = _usable(sites, catalogue)
    first = [_first_look(site, catalogue, params) for site in usable]
    resting = frozenset(catalogue.names) - {catalogue.mapping}
    jumps = table_jumps([(cameras, pixels, points) for cameras, pixels, points, _ in first], resting, params)
    notes += table_notes([site.site for site in usable], jumps)
    wrong = wrong_spacings([(pixels, points, joint) for _, pixels, points, joint in first], catalogue)
    notes += _spacing_notes(wrong, catalogue)
    if set(wrong) == set(catalogue.names):
        # Names and scale both rest on the spacings: nothing that was located can be trusted.
        reasons = (Reason.SPACING_MISMATCH, Reason.GEOMETRY_DOUBTFUL)
        refused = [RejectedSite(site.site, reasons) for site in usable]
        return Triangulation((), (*rejected, *refused), tuple(notes))
    alike = _same_gantry(usable)
    asked = [first[i][:2] for i in alike if jumps[i] is None]
    calibration, gantry = calibrate(asked, catalogue, frozenset(catalogue.names) - set(wrong), params)
    if calibration is not None and calibration.applied:
        notes.append(_calibration_note(calibration))
    header = GantryBelief(np.eye(4), params.gantry_covariance())
    work = [
        (site, jump, Locator(method, params, catalogue, gantry if i in alike else header, frozenset(wrong)))
        for i, (site, jump) in enumerate(zip(usable, jumps, strict=True))
    ]
    return _located(work, context, rejected, notes, calibration)


def _usable(
    sites: Sequence[MatchedSite], catalogue: Catalogue
) -> tuple[list[MatchedSite], list[RejectedSite], list[str]]:
    usable, rejected, notes = [], [], []
    for site in sites:
        angle = ray_angle_deg(site.camera_a, site.camera_b)
        if angle < PARALLEL_BELOW_DEG:
            rejected.append(RejectedSite(site.site, (Reason.VIEWS_PARALLEL,)))
            notes.append(f"{site.site}: the views are {angle:.0f} degrees apart; at least 20 are needed.")
        elif catalogue.mapping not in seen_in_both(site.diastole).catheters:
            rejected.append(RejectedSite(site.site, (Reason.CATHETER_NOT_FOUND,)))
        else:
            usable.append(site)
    return usable, rejected, notes


def _located(
    work: Sequence[tuple[MatchedSite, Jump | None, Locator]],
    context: Context,
    rejected: list[RejectedSite],
    notes: list[str],
    calibration: Calibration | None,
) -> Triangulation:
    located: list[LocatedSite] = []
    moments: list[Moment] = []
    for index, (site, jump, locator) in enumerate(work):
        context.check()
        answer = locator.locate(site, jump)
        if answer is None:
            rejected.append(RejectedSite(site.site, (Reason.PAIRING_FAILED,)))
        else:
            located.append(answer[0])
            moments.append(answer[1])
            notes += answer[2]
        context.progress((index + 1) / len(work))
    return Triangulation(tuple(located), tuple(rejected), tuple(notes), calibration, _budget(moments))


def _first_look(
    site: MatchedSite, catalogue: Catalogue, params: UncertaintyParams
) -> tuple[Cameras, TwoViewPixels, Array, Array]:
    """Nominal cameras, pixels, points (N, 3), and their covariance (N, 3, N, 3) from the pixels alone."""
    cameras, pixels = (site.camera_a, site.camera_b), seen_in_both(site.diastole)
    points = triangulate_maximum_likelihood(*cameras, *pixels.pixels, *pixels.covariances)
    sources = error_sources(cameras, points, pixels.labels, catalogue, params, GANTRY_PRIOR, None)
    pixels = strays_doubted(cameras, pixels, points, sources)
    alone = Estimate(points, alone_gain(cameras, points))
    return cameras, pixels, points, alone.covariance_mm2(pixel_noise_px2(pixels.covariances))


def _same_gantry(sites: Sequence[MatchedSite]) -> list[int]:
    """The largest set of sites taken with the same two gantry positions: only those share the gantry's errors."""
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
            "The electrodes of every catheter are spaced otherwise than described: check the pixel spacing and the source "
            "distances of both runs, then the description of the catheters."
        ]
    notes = []
    for name, gaps in wrong.items():
        told = ", ".join(
            f"{gap.first} to {gap.second}: {gap.found_mm:.1f} mm instead of {gap.told_mm:.1f}" for gap in gaps
        )
        notes.append(
            f"The electrodes of the catheter {name!r} are not spaced as its description says ({told}); its description "
            "was not used to check the gantry. Correct it."
        )
    return notes


def _calibration_note(calibration: Calibration) -> str:
    angle, offset = np.linalg.norm(calibration.rotation_deg), np.linalg.norm(calibration.offset_mm)
    return (
        f"The two views contradict each other more than their pixels allow; view b was turned by {angle:.2f} degrees and "
        f"shifted by {offset:.1f} mm against its header, which brings the electrodes' mean epipolar distance from "
        f"{calibration.epipolar_before_px:.1f} to {calibration.epipolar_after_px:.1f} px."
    )


def _budget(moments: Sequence[Moment]) -> ErrorBudget | None:
    """RMS over all located electrodes, of each source of error on its own; none where nothing was located."""
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
