"""Wrong answers without a warning: ``python benchmarks/silent_wrongs.py [first seed] [studies] [studies a stratum]``.

The first stratum draws every property of :mod:`fluoromap.phantom.conditions` at once. Each further stratum draws one
property, in studies that are calm otherwise; ``calm`` draws none. The pixels are the true ones with 0.5 px of noise; nothing is
rendered. Each study goes through matching, ``maximum-likelihood`` and ``motion-prior`` (both views of two of its sites).

Columns, for points and for track samples: RMS error in mm from the isocentre; the RMS of the baseline (tracks); the share of
95 % ellipsoids that contain the truth, from the isocentre and relative to the reference catheter, with a 95 % bootstrap
interval over studies; the mean chi-squared over 3. ``names`` counts catheters at a site with a wrong name: all, those without a
reason that says so, those graded A or B. ``silent`` counts answers that are farther than 3 mm from the truth at grade A, or
6 mm at grade B, and have no reason that casts doubt on them. Electrodes with a wrong name count under ``names`` and under
``silent``, not under the other columns.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import (
    CHI2_95_3D,
    Grade,
    LocatedSite,
    MatchedSite,
    MonoplaneView,
    Refusal,
    Silent,
    Triangulation,
    View,
    grade_of,
)
from fluoromap.matching import match_study
from fluoromap.monoplane.motion_prior import MotionPrior
from fluoromap.monoplane.track_samples import in_study
from fluoromap.phantom.clinical_study import ClinicalRun, ClinicalSite, ClinicalStudy, simulate_conditions
from fluoromap.phantom.conditions import PROPERTIES, Conditions, Property
from fluoromap.reasons import Reason
from fluoromap.triangulator.maximum_likelihood import MaximumLikelihood
from fluoromap.triangulator.uncertainty import UncertaintyParams

Array = NDArray[np.float64]

TRACKED_SITES = 2
MOST_FRAMES = 90
"""Tracks of longer runs are scored in their first frames only."""
NEAR_PX = 5.0
NO_DOUBT = frozenset({
    Reason.IDENTITY_BY_MOTION, Reason.MOTION_FROM_OTHERS, Reason.TRACK_INTERRUPTED, Reason.OUT_OF_FIELD, Reason.NO_REFERENCE,
    Reason.NO_ACTIVATION_TIME, Reason.OUTSIDE_WINDOW, Reason.LAT_OUTLIER, Reason.IRREGULAR_RHYTHM,
})  # fmt: skip
"""Reasons that nearly every study has, or that say nothing about a position."""
NAME_DOUBTS = frozenset({Reason.IDENTITY_UNCERTAIN, Reason.EXTRA_CATHETER})


@dataclass
class Sums:
    """Sums over the answers of one study, one kind of answer. Each list has the entries absolute and relative."""

    count: int = 0
    squared: float = 0.0
    baseline: float = 0.0
    counted: list[int] = field(default_factory=lambda: [0, 0])
    inside: list[int] = field(default_factory=lambda: [0, 0])
    chi2: list[float] = field(default_factory=lambda: [0.0, 0.0])
    relative_squared: float = 0.0
    silent: int = 0
    judged: int = 0

    def add(self, kind: int, errors: Array, covariances: Array) -> None:
        """Add errors (k, 3) with covariances (k, 3, 3); kind 0 is absolute, 1 relative."""
        distance = np.einsum("ki,ki->k", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])
        self.counted[kind] += len(errors)
        self.inside[kind] += int((distance <= CHI2_95_3D).sum())
        self.chi2[kind] += float(np.minimum(distance, 1e4).sum()) / 3


@dataclass
class StudyScore:
    """Everything that one study adds to the table."""

    points: Sums = field(default_factory=Sums)
    tracks: Sums = field(default_factory=Sums)
    catheters: int = 0
    misnamed: int = 0
    misnamed_unflagged: int = 0
    misnamed_above_c: int = 0
    rejected: int = 0
    sites: int = 0
    calibrated: bool = False
    silent_reports: list[str] = field(default_factory=list)


def score_study(conditions: Conditions) -> StudyScore:
    """Run the pipeline on one study and score its answers."""
    study = simulate_conditions(conditions)
    matching = match_study(study.runs, study.catalogue, Silent())
    located = MaximumLikelihood(UncertaintyParams()).triangulate(matching.sites, study.catalogue, Silent())
    score = StudyScore(sites=len(study.truth), rejected=len(study.truth) - len(located.sites))
    score.calibrated = located.calibration is not None and located.calibration.applied
    truth = {site.name: site for site in study.truth}
    matched = {site.site: site for site in matching.sites}
    for index, site in enumerate(located.sites):
        wrong = misnamed_catheters(matched[site.site], truth[site.site])
        score_names(score, site, matched[site.site], wrong)
        score_points(score, study, site, truth[site.site], wrong)
        if index < TRACKED_SITES:
            for view in (0, 1):
                score_track(score, study, matched[site.site], site, located, truth[site.site].runs[view], view, wrong)
    return score


def misnamed_catheters(matched: MatchedSite, truth: ClinicalSite) -> frozenset[str]:
    """Return the names that either view gave to another catheter at diastole."""
    wrong = set()
    for observation, run in zip((matched.runs.diastole.a, matched.runs.diastole.b), truth.runs, strict=True):
        for chain in observation.chains:
            place = run.pixels_uv[chain.catheter][observation.frame][[number - 1 for number in chain.electrodes]]
            if np.linalg.norm(chain.pixels_uv - place, axis=1).max() > 3 * NEAR_PX:
                wrong.add(chain.catheter)
    return frozenset(wrong)


def reasons_of(site: LocatedSite, matched: MatchedSite, catheter: str) -> frozenset[Reason]:
    """Return every reason that a catheter's points have in the database."""
    own = {reason for point in site.points if point.catheter == catheter for reason in point.reasons}
    return frozenset(own | {*site.reasons} | {reason for name, reason in matched.notes if name == catheter})


def score_names(score: StudyScore, site: LocatedSite, matched: MatchedSite, wrong: frozenset[str]) -> None:
    for name in {point.catheter for point in site.points}:
        score.catheters += 1
        if name in wrong:
            reasons = reasons_of(site, matched, name)
            grades = {grade_of(point.covariance_mm2, reasons) for point in site.points if point.catheter == name}
            score.misnamed += 1
            score.misnamed_unflagged += not reasons & NAME_DOUBTS
            score.misnamed_above_c += bool(grades & {Grade.A, Grade.B})


def is_silent(error_mm: float, grade: Grade, reasons: Iterable[Reason]) -> bool:
    limit = {Grade.A: 3.0, Grade.B: 6.0}.get(grade, np.inf)
    return error_mm > limit and not set(reasons) - NO_DOUBT


def score_points(
    score: StudyScore, study: ClinicalStudy, site: LocatedSite, truth: ClinicalSite, wrong: frozenset[str]
) -> None:
    sums, reference = score.points, study.catalogue.reference
    origin = truth.diastole_mm[reference].mean(axis=0)
    for point in site.points:
        place = truth.diastole_mm[point.catheter][point.electrode - 1]
        reasons = site.reasons_of(point.catheter, point.electrode)
        error = point.position_mm - place
        size = float(np.linalg.norm(error))
        sums.judged += 1
        silent = is_silent(size, grade_of(point.covariance_mm2, reasons), reasons)
        if point.catheter not in wrong:
            sums.count += 1
            sums.squared += size**2
            sums.add(0, error[None], point.covariance_mm2[None])
        if point.relative_mm is not None and point.relative_covariance_mm2 is not None:
            from_origin = point.relative_mm - (place - origin)
            size = float(np.linalg.norm(from_origin))
            reasons = site.reasons_of(point.catheter, point.electrode, reference)
            silent |= is_silent(size, grade_of(point.relative_covariance_mm2, reasons), reasons)
            if not wrong & {point.catheter, reference}:
                sums.relative_squared += size**2
                sums.add(1, from_origin[None], point.relative_covariance_mm2[None])
        sums.silent += silent
        if silent:
            score.silent_reports.append(
                f"seed {study.conditions.seed} {site.site} {point.catheter} {point.electrode}: {size:.1f} mm "
                f"{'wrong name' if point.catheter in wrong else ''} {sorted(map(str, reasons))}"
            )


def score_track(
    score: StudyScore, study: ClinicalStudy, matched: MatchedSite, site: LocatedSite, located: Triangulation, run: ClinicalRun,
    view: int, wrong: frozenset[str],
) -> None:  # fmt: skip
    sums, reference = score.tracks, study.catalogue.reference
    try:
        seen = monoplane_view(study, matched, site, located, view)
        track = MotionPrior(MotionPrior.Params()).track(seen, Silent())
    except Refusal:
        return
    track = in_study(track, seen.camera, reference, site.variation)
    frames = slice(0, MOST_FRAMES)
    truth = np.stack([run.points_mm[name][frames, number - 1] for name, number in track.labels], axis=1)
    error = track.positions_mm[frames] - truth
    names = [name for name, _ in track.labels]
    is_reference = np.array([name == reference for name in names])
    size = np.linalg.norm(error, axis=2)
    before = np.linalg.norm(track.baseline_mm[frames] - truth, axis=2)
    relative_covariance = track.relative_covariance_mm2
    relative = error - error[:, is_reference].mean(axis=1, keepdims=True) if is_reference.any() else None
    for index, name in enumerate(names):
        shown = track.located[frames, index]
        reasons = (*track.reasons[index], *site.reasons_of(*track.labels[index]))
        grades = np.array([grade_of(one, reasons) for one in track.covariance_mm2[frames, index]])
        limit = np.where(grades == Grade.A, 3.0, np.where(grades == Grade.B, 6.0, np.inf))
        silent = shown & (size[:, index] > limit) & (not set(reasons) - NO_DOUBT)
        sums.judged += int(shown.sum())
        sums.silent += int(silent.sum())
        if silent.any():
            score.silent_reports.append(
                f"seed {study.conditions.seed} {site.site} view {view} track of {name}: {int(silent.sum())} samples to "
                f"{size[silent, index].max():.1f} mm {'wrong name' if name in wrong else ''} {sorted(map(str, reasons))}"
            )
        if name in wrong:
            continue
        sums.count += int(shown.sum())
        sums.squared += float((size[shown, index] ** 2).sum())
        sums.baseline += float((before[shown, index] ** 2).sum())
        sums.add(0, error[shown, index], track.covariance_mm2[frames, index][shown])
        if relative is not None and relative_covariance is not None and name != reference and reference not in wrong:
            sums.relative_squared += float((relative[shown, index] ** 2).sum())
            sums.add(1, relative[shown, index], relative_covariance[frames, index][shown])


def monoplane_view(
    study: ClinicalStudy, matched: MatchedSite, site: LocatedSite, located: Triangulation, view: int
) -> MonoplaneView:
    """Return the input of the solver, as the workers build it."""
    name: View = "b" if view else "a"
    return MonoplaneView(
        site=site.site,
        view=name,
        camera=site.camera_b if view else site.camera_a,
        catalogue=study.catalogue,
        frame_times_ms=matched.runs.frame_times_b_ms if view else matched.runs.frame_times_a_ms,
        observations=matched.runs.track_b if view else matched.runs.track_a,
        a_priori=site.a_priori_points,
        a_priori_frame=site.frame_b if view else site.frame_a,
        cycle=site.cycle,
        others=() if site.cycle else tuple(one.cycle for one in located.sites if one.cycle),
    )


def interval(numerators: Sequence[float], denominators: Sequence[float]) -> str:
    """Return a ratio of sums over studies in percent, with its interval."""
    top, bottom = np.array(numerators, dtype=float), np.array(denominators, dtype=float)
    if not bottom.sum():
        return f"{'-':>17}"
    drawn = np.random.default_rng(0).integers(0, len(top), (2000, len(top)))
    low, high = np.percentile(top[drawn].sum(axis=1) / np.maximum(bottom[drawn].sum(axis=1), 1), [2.5, 97.5])
    return f"{100 * top.sum() / bottom.sum():5.1f} ({100 * low:4.1f}-{100 * high:5.1f})"


def rows(name: str, scores: Sequence[StudyScore]) -> list[str]:
    """Return the table's two lines of a stratum."""
    lines = []
    for kind in ("points", "tracks"):
        sums: list[Sums] = [getattr(score, kind) for score in scores]
        count, relative = max(sum(s.count for s in sums), 1), max(sum(s.counted[1] for s in sums), 1)
        rms = np.sqrt(sum(s.squared for s in sums) / count)
        base = np.sqrt(sum(s.baseline for s in sums) / count) if kind == "tracks" else np.nan
        from_reference = np.sqrt(sum(s.relative_squared for s in sums) / relative)
        chi2 = [sum(s.chi2[k] for s in sums) / max(sum(s.counted[k] for s in sums), 1) for k in (0, 1)]
        inside = [interval([s.inside[k] for s in sums], [s.counted[k] for s in sums]) for k in (0, 1)]
        silent, judged = sum(s.silent for s in sums), sum(s.judged for s in sums)
        lines.append(
            f"{name if kind == 'points' else '':12}{kind:7}{rms:6.2f}{base:6.2f}{rms / base:6.2f}{from_reference:6.2f} "
            f"{inside[0]} {inside[1]}{chi2[0]:6.2f}{chi2[1]:6.2f}{silent:7}/{judged:<8}"
        )
    names = [sum(getattr(score, of) for score in scores) for of in (
        "misnamed", "misnamed_unflagged", "misnamed_above_c", "catheters", "rejected", "sites", "calibrated",
    )]  # fmt: skip
    lines[0] += (
        f" {names[0]} wrong, {names[1]} unflagged, {names[2]} above C of {names[3]}; {names[4]} of {names[5]} sites "
        f"rejected; {names[6]} of {len(scores)} calibrated"
    )
    return lines


def main(first_seed: int, studies: int, each: int) -> None:
    """Print the table; two processes share the work."""
    print(f"{studies} studies with everything drawn, {each} a stratum, from seed {first_seed}")
    print(
        f"{'stratum':12}{'':7}{'RMS':>6}{'base':>6}{'ratio':>6}{'rel.':>6} {'inside, absolute':>18} {'relative':>17}"
        f"{'chi2':>6}{'rel.':>6}{'silent':>11}      names"
    )
    strata: list[tuple[str, tuple[Property, ...], int]] = [("all", PROPERTIES, studies), ("calm", (), each)]
    strata += [(name, (name,), each) for name in PROPERTIES]
    silent: list[str] = []
    with ProcessPoolExecutor(min(os.cpu_count() or 1, 2)) as pool:
        for number, (name, properties, count) in enumerate(strata):
            seeds = range(first_seed + 1000 * number, first_seed + 1000 * number + count)
            drawn = [Conditions.draw(seed, properties) for seed in seeds]
            scores = list(pool.map(score_study, drawn, chunksize=4))
            for line in rows(name, scores) if scores else []:
                print(line, flush=True)
            silent += [f"{name}: {report}" for score in scores for report in score.silent_reports]
    print(f"\nsilently wrong: {len(silent) or 'nothing'}")
    for report in silent:
        print(report)


if __name__ == "__main__":
    words = [int(word) for word in sys.argv[1:]]
    main(*(*words, *(30_000, 200, 24)[len(words) :]))
