"""Self-calibration: errors of the gantry and variation of the heart, from the electrodes of a whole study.

Errors of the gantry are common to the study, and so are errors of the catalogue's gaps. Breathing is common to one run of one
site. A beat is common to one catheter in one run. The electrodes' epipolar distances and gaps over all sites separate them.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc, logsumexp

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Calibration, StudyVariation
from fluoromap.reasons import Reason
from fluoromap.triangulator.gantry_kinds import GANTRY_KINDS, LARGEST_MULTIPLE, credible_covariance
from fluoromap.triangulator.study_equations import (
    GANTRY_UNKNOWNS,
    GAP_SD_MM,
    HEART_SCALES,
    CalibrationSite,
    HeartScale,
    Information,
    SiteEquations,
    gap_labels,
    information,
    log_evidences,
    scatter_log_likelihoods,
    site_equations,
)
from fluoromap.triangulator.two_view_pixels import Cameras
from fluoromap.triangulator.uncertainty import UncertaintyParams

GATE_EPIPOLAR_RATIO = 1.3
"""Ratio of epipolar RMS to pixel noise below which the header is believed."""
GATE_LOG_ODDS = 3.0
"""Natural logarithm of the odds for a wrong header against a right one (20 to 1) above which calibration may apply."""
FEWEST_SITES = 3
FEWEST_ELECTRODES = 28
"""Twice the gantry's unknowns: on a real C-arm, calibration from fewer landmarks made distances worse."""
FARTHEST_CHI2 = 22.46
"""99.9th percentile of chi-squared with 6 degrees of freedom: a larger difference from the header is no gantry error."""
FARTHEST_OFFSET_MM = 6.0
"""Largest offset of one view against the other that a gantry can have; a larger one is a moved table."""
STILL_MISFIT = 2.0
"""Misfit an equation (1 is expected) above which the calibrated gantry does not explain the electrodes either."""
LEAST_AGREEING = 0.7
"""Share of the sites that must agree with some gantry and some heart, for the others to be left out."""
UNEXPLAINED_BELOW = 1e-6
"""Probability of a site's misfit by chance below which its electrodes are wrong."""
_STEPS = 4
_AS_HEADER = (np.eye(4), np.eye(4))
_NEGLIGIBLE = 9.0
"""Difference of log evidence beyond which a kind of heart counts as ruled out."""


@dataclass(frozen=True, eq=False)
class GantryBelief:
    """The gantry's estimated error and its remaining uncertainty.

    displacements : (4, 4) of the world as view a and view b see it; the identity where the header is believed.
    covariance : (14, 14) of the remaining errors, see :func:`~fluoromap.triangulator.error_sources.gantry_effect_px`.
    """

    displacements: tuple[Array, Array]
    covariance: Array

    @functools.cached_property
    def _as_header(self) -> bool:
        return all((one == np.eye(4)).all() for one in self.displacements)

    def cameras(self, nominal: Cameras) -> Cameras:
        """Return the cameras corrected from the header's nominal ones."""
        if self._as_header:
            return nominal
        in_a, in_b = self.displacements
        return nominal[0].displaced(in_a), nominal[1].displaced(in_b)


@dataclass(frozen=True, eq=False)
class StudyBelief:
    """All that a study shows about its gantry and its heart.

    params : the parameters with this heart's breathing and beat variation. doubt : TABLE_MOVED or GEOMETRY_DOUBTFUL where
    the electrodes contradict the header in a way that no gantry explains.
    """

    gantry: GantryBelief
    params: UncertaintyParams
    variation: StudyVariation
    doubt: Reason | None = None


def any_study_belief(params: UncertaintyParams) -> StudyBelief:
    """Return the belief about any gantry and any heart, as second moments.

    Solvers estimate with it. :func:`header_belief` has the tails too, for the ellipsoids that are stated.
    """
    return _belief(GantryBelief(_AS_HEADER, params.header_covariance()), HeartScale(), params)


def header_belief(params: UncertaintyParams) -> StudyBelief:
    """Return the belief where no electrode shows the gantry's error or the heart's variation."""
    covariance = credible_covariance(*params.header_moments())
    return _belief(GantryBelief(_AS_HEADER, covariance), HeartScale(), params)


def study_belief(
    gantry: GantryBelief, variation: StudyVariation, params: UncertaintyParams, doubt: Reason | None
) -> StudyBelief:
    """Return the belief about a study whose variation is known."""
    return StudyBelief(gantry, params.scaled(variation.breathing, variation.beats), variation, doubt)


def calibrate(
    sites: Sequence[CalibrationSite],
    catalogue: Catalogue,
    trusted: frozenset[str],
    params: UncertaintyParams,
    as_stated: Sequence[SiteEquations] | None = None,
) -> tuple[Calibration | None, StudyBelief]:
    """Estimate the gantry's error from all sites, and decide whether to apply it.

    The unknowns are rotation, offset and scale of each view, and one error of the catalogue for each gap. The data are the
    signed epipolar distance of every electrode and the distances between neighbours. Gantries are a mixture: most have the
    errors that the parameters state, some have 2 or 4 times as large ones. The evidence of the study weighs them, together
    with the breathing and the beat variation of its heart.

    The header is kept unless both hold: the epipolar RMS exceeds 1.3 times the pixel noise, and the odds for a wrong header
    against breathing, beats and wrong gaps exceed 20 to 1. A header that is kept is as uncertain as the study leaves it.

    Parameters
    ----------
    sites : sequence of CalibrationSite
        Sites taken with the same two gantry positions.
    trusted : frozenset of str
        Catheters whose spacings agree with the catalogue's.
    as_stated : sequence of SiteEquations, optional
        Equations of the sites with the gantry that the headers state, where they are known.

    Returns
    -------
    tuple
        The calibration for the report (None with fewer than three sites), and the belief that locates the sites.
    """
    usual = params.gantry_covariance()
    if len(sites) < FEWEST_SITES:
        return None, header_belief(params)
    gaps = gap_labels(catalogue, trusted)

    def equations(gantry: GantryBelief) -> list[SiteEquations]:
        return [site_equations(site, gantry.cameras(site.cameras), catalogue, gaps, params) for site in sites]

    unknowns = GANTRY_UNKNOWNS + len(gaps)
    rows = list(as_stated) if as_stated is not None else equations(GantryBelief(_AS_HEADER, usual))
    agree = _are_explained(rows, usual, len(gaps))
    if sum(agree) >= max(FEWEST_SITES, LEAST_AGREEING * len(sites)):
        # One site with wrong electrodes would pass for a heart with large beats, and widen the others' ellipsoids.
        sites = [site for site, explained in zip(sites, agree, strict=True) if explained]
        rows = [one for one, explained in zip(rows, agree, strict=True) if explained]
    scatter = scatter_log_likelihoods(sites, params)
    mixture = _weigh(information(rows, np.zeros(unknowns), scatter), usual, len(gaps))
    noise = float(np.sqrt(np.mean(np.concatenate([one.pixel_variance for one in rows]))))
    before = _epipolar_rms_px(rows, mixture, np.zeros(unknowns), params)
    as_header = GantryBelief(_AS_HEADER, mixture.gantry_covariance(np.zeros(GANTRY_UNKNOWNS)))
    kept = Calibration(False, np.zeros(3), np.zeros(3), before, before)
    electrodes = sum(one.epipolar for one in rows)
    if electrodes < FEWEST_ELECTRODES or before <= GATE_EPIPOLAR_RATIO * noise or mixture.log_odds <= GATE_LOG_ODDS:
        return kept, _belief(as_header, mixture.scale, params)
    found = np.zeros(6)
    for _ in range(_STEPS):
        found = mixture.mean[6:12] - mixture.mean[:6]
        at = np.concatenate([np.zeros(6), found, np.zeros(unknowns - 12)])
        rows = equations(GantryBelief((np.eye(4), _displacement(found)), usual))
        mixture = _weigh(information(rows, at, scatter), usual, len(gaps))
    after = _epipolar_rms_px(rows, mixture, at, params)
    # No electrode shows which view is wrong: each takes its expected share of the difference.
    in_a = mixture.mean[:6]
    displacements = _displacement(in_a), _displacement(found) @ _displacement(in_a)
    corrected = GantryBelief(displacements, mixture.gantry_covariance(np.array([*in_a, *(found + in_a), 0.0, 0.0])))
    distance = found**2 / (2 * LARGEST_MULTIPLE**2 * np.diagonal(usual)[6:12])
    offset_mm = float(np.linalg.norm(found[3:]))
    shifted = offset_mm > FARTHEST_OFFSET_MM and float(distance[:3].sum()) < float(distance[3:].sum())
    doubt = Reason.TABLE_MOVED if shifted else Reason.GEOMETRY_DOUBTFUL
    if float(distance.sum()) > FARTHEST_CHI2 or _misfit(rows, mixture.scale) > STILL_MISFIT:
        # Something else is wrong, such as a mirrored image, a moved table or runs of another study.
        covariance = as_header.covariance + LARGEST_MULTIPLE**2 * usual
        return kept, _belief(GantryBelief(_AS_HEADER, covariance), mixture.scale, params, doubt)
    calibration = Calibration(True, np.degrees(found[:3]), found[3:], before, after)
    return calibration, _belief(corrected, mixture.scale, params, doubt if shifted else None)


def _belief(
    gantry: GantryBelief, scale: HeartScale, params: UncertaintyParams, doubt: Reason | None = None
) -> StudyBelief:
    usual = np.diagonal(params.gantry_covariance())[:12].reshape(2, 2, 3)
    shares = np.diagonal(gantry.covariance)[:12].reshape(2, 2, 3) / np.maximum(usual, 1e-12)
    angle, offset = np.sqrt(shares.mean(axis=(0, 2)))
    variation = StudyVariation(scale.breathing, scale.beats, float(angle), float(offset))
    return study_belief(gantry, variation, params, doubt)


def _displacement(six: Array) -> Array:
    """Return the displacement (4, 4) ``X' = R X + t`` of a rotation vector (radians) and an offset (mm)."""
    displacement = np.eye(4)
    displacement[:3, :3] = Rotation.from_rotvec(six[:3]).as_matrix()
    displacement[:3, 3] = six[3:]
    return displacement


@dataclass(frozen=True, eq=False)
class _Mixture:
    """The unknowns over all kinds of gantry and heart, weighed by their evidence.

    mean : (u,) of the unknowns against header and catalogue. covariance : (14, 14) of the gantry's errors about their mean; its
    95 % ellipsoids hold 95 % of the mixture. scale : RMS of the heart's scales. log_odds : for a gantry with errors against one
    without.
    """

    mean: Array
    covariance: Array
    scale: HeartScale
    log_odds: float

    def gantry_covariance(self, about: Array) -> Array:
        """Return the second moment (14, 14) of the gantry's errors about the applied correction ``about`` (14,)."""
        left = self.mean[:GANTRY_UNKNOWNS] - about
        moment: Array = self.covariance + np.outer(left, left)
        return moment


def _prior(multiples: Array, usual: Array, gaps: int) -> Array:
    """Return the covariance (u, u) of the unknowns before the study, with these multiples (14,) of the usual gantry."""
    whole = np.zeros((GANTRY_UNKNOWNS + gaps,) * 2)
    whole[:GANTRY_UNKNOWNS, :GANTRY_UNKNOWNS] = multiples[:, None] * usual * multiples
    whole[GANTRY_UNKNOWNS:, GANTRY_UNKNOWNS:] = GAP_SD_MM**2 * np.eye(gaps)
    return whole


def _are_explained(rows: Sequence[SiteEquations], usual: Array, gaps: int) -> list[bool]:
    """Return whether the worst gantry and most irregular heart explain sites."""
    prior = _prior(np.full(GANTRY_UNKNOWNS, LARGEST_MULTIPLE), usual, gaps)
    worst = HeartScale(max(one.breathing for one in HEART_SCALES), max(one.beats for one in HEART_SCALES))
    alike: dict[int, list[int]] = {}
    for index, one in enumerate(rows):
        alike.setdefault(len(one.residual), []).append(index)
    explained = [False] * len(rows)
    for equations, sites in alike.items():
        slopes = np.array([rows[site].slope for site in sites])
        covariances = np.array([rows[site].covariance(worst) for site in sites])
        covariances += slopes @ prior @ np.swapaxes(slopes, -1, -2)
        residuals = np.array([rows[site].residual for site in sites])
        misfits = (residuals * np.linalg.solve(covariances, residuals[..., None])[..., 0]).sum(axis=1)
        for site, probability in zip(sites, chdtrc(equations, misfits).tolist(), strict=True):
            explained[site] = probability >= UNEXPLAINED_BELOW
    return explained


def _weigh(hearts: Sequence[Information], usual: Array, gaps: int) -> _Mixture:
    """Weigh all kinds of gantry and heart by their evidence.

    No electrode shows an error that both views share, so each kind of gantry keeps its own prior there.
    """
    widest = _prior(np.full(GANTRY_UNKNOWNS, LARGEST_MULTIPLE), usual, gaps)
    at_widest = log_evidences(hearts, widest)
    likely_hearts = at_widest > at_widest.max() - _NEGLIGIBLE
    plausible = [heart for heart, is_likely in zip(hearts, likely_hearts, strict=True) if is_likely]
    kinds = [
        (heart, of_gantry, float(np.log(kind.share)) + float(evidence))
        for kind in GANTRY_KINDS
        for of_gantry in [_prior(kind.multiples, usual, gaps)]
        for heart, evidence in zip(plausible, log_evidences(plausible, of_gantry), strict=True)
    ]
    evidence = np.array([one for *_, one in kinds])
    weights = np.exp(evidence - logsumexp(evidence))
    no_error = _prior(np.zeros(GANTRY_UNKNOWNS), usual, gaps)
    exact = logsumexp(log_evidences(hearts, no_error))
    likely = [(kind, weight) for kind, weight in zip(kinds, weights, strict=True) if weight > 1e-4]
    total = sum(weight for _, weight in likely)
    answers = [(heart.posterior(of_gantry), weight / total) for (heart, of_gantry, _), weight in likely]
    mean = np.sum([weight * own for (_, own), weight in answers], axis=0)
    moments = np.array(
        [(own + np.outer(at - mean, at - mean))[:GANTRY_UNKNOWNS, :GANTRY_UNKNOWNS] for (own, at), _ in answers]
    )
    covariance = credible_covariance(np.array([weight for _, weight in answers]), moments)
    breathing, beats = (
        float(np.sqrt(sum(weight / total * getattr(heart.scale, of) ** 2 for (heart, *_), weight in likely)))
        for of in ("breathing", "beats")
    )
    simultaneous = sum(weight / total for (heart, *_), weight in likely if heart.scale.simultaneous)
    scale = HeartScale(breathing, beats, bool(simultaneous > 0.5))
    return _Mixture(mean, covariance, scale, float(logsumexp(evidence) - exact))


def _misfit(rows: Sequence[SiteEquations], scale: HeartScale) -> float:
    """Return the mean squared misfit an equation.

    It is 1 where pixels, breathing and beats explain the residuals.
    """
    total = sum(float(one.residual @ np.linalg.solve(one.covariance(scale), one.residual)) for one in rows)
    return total / sum(len(one.residual) for one in rows)


def _epipolar_rms_px(
    rows: Sequence[SiteEquations], mixture: _Mixture, linearised_at: Array, params: UncertaintyParams
) -> float:
    """Return the Sampson RMS over the study, without each site's breathing.

    The equations were linearised at the unknowns ``linearised_at`` (u,).
    """
    left = []
    prior = mixture.scale.breathing**2 * params.respiration_covariance_mm2() / 2
    for one in rows:
        k = slice(one.epipolar)
        if not one.shows_beats(mixture.scale):
            left.append(one.residual[k])
            continue
        unexplained = one.residual[k] - one.slope[k] @ (mixture.mean - linearised_at)
        breath = prior @ one.breath[k].T @ np.linalg.solve(one.covariance(mixture.scale)[k, k], unexplained)
        left.append(one.residual[k] - one.breath[k] @ breath)
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
