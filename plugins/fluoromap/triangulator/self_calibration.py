"""Self-calibration: rotation and offset of view b's camera against the header, from a study's electrodes.

Errors of the gantry are common to the study. Breathing is common to one run of one site. A beat is common to one catheter
in one run. The electrodes' epipolar distances over all sites separate the three.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Calibration
from fluoromap.geometry import Camera
from fluoromap.triangulator.estimate import separate_gain, triangulate_maximum_likelihood
from fluoromap.triangulator.spacing import neighbours
from fluoromap.triangulator.stray_electrodes import epipolar_rows
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels
from fluoromap.triangulator.uncertainty import (
    Share,
    UncertaintyParams,
    breathing_effect_px,
    error_sources,
    gantry_effect_px,
    jacobians,
    pixel_noise_px2,
)

ROTATION_SD_DEG = 1.0
OFFSET_SD_MM = 2.0
"""Prior standard deviations of view b's rotation and offset against view a and the header, an axis."""
GANTRY_PRIOR = np.diag(np.tile(np.repeat(np.square([np.radians(ROTATION_SD_DEG), OFFSET_SD_MM]), 3), 2)) / 2
"""Covariance (12, 12) of both views' errors; each view has half of the variance of b against a."""
WORSE_SHARE = 0.03
"""Share of gantries with errors as large as GANTRY_PRIOR; the others have the errors that the parameters state."""
GATE_EPIPOLAR_RATIO = 1.3
"""Ratio of epipolar RMS to pixel noise below which the header is believed."""
GATE_LOG_ODDS = 3.0
"""Natural logarithm of the odds for a wrong gantry against a right one (20 to 1) above which calibration may apply."""
FEWEST_SITES = 3
FARTHEST_CHI2 = 22.46
"""99.9th percentile of chi-squared with 6 degrees of freedom: a larger difference from the header is no gantry error."""
STILL_MISFIT = 2.0
"""Misfit an equation (1 is expected) above which the calibrated gantry does not explain the electrodes either."""
_SPACING_SD_MM = 0.1
_STEPS = 4
_SCALED: tuple[Share, ...] = ("breathing", "phase_mismatch")
_SCALE_LOG_SD = 1.1


@dataclass(frozen=True, eq=False)
class GantryBelief:
    """The gantry's estimated error and its remaining uncertainty.

    camera_b_displacement : (4, 4) displacement of the world as view b sees it; the identity where the header is believed.
    covariance : (12, 12) of the remaining errors, see :func:`~fluoromap.triangulator.uncertainty.gantry_effect_px`.
    """

    camera_b_displacement: Array
    covariance: Array

    def cameras(self, nominal: Cameras) -> Cameras:
        """Return the cameras corrected from the header's nominal ones."""
        return nominal[0], displaced_camera(nominal[1], self.camera_b_displacement)


def displaced_camera(camera: Camera, turn: Array) -> Camera:
    """Return the camera of a view that sees the world displaced by ``turn`` (4, 4)."""
    return Camera(camera.matrix @ turn, camera.rows, camera.columns)


@dataclass(frozen=True, eq=False)
class _SiteEquations:
    """One site's k equations ``residual = slope g + error`` for the gantry's 12 unknowns g.

    The first ``epipolar`` equations are epipolar distances in px, the others electrode spacings in mm.

    residual : (k,). slope : (k, 12). fixed : (k, k) covariance of the error from pixels and from the catalogue's spacings.
    breathing, beats : (k, k) covariances from breathing and from beats. breath : (k, 3) effect of breathing, an mm.
    pixel_variance : (epipolar,) px^2.
    """

    residual: Array
    slope: Array
    fixed: Array
    breathing: Array
    beats: Array
    breath: Array
    epipolar: int
    pixel_variance: Array

    def covariance(self, scale: _Scale) -> Array:
        total: Array = self.fixed + scale.breathing**2 * self.breathing + scale.beats**2 * self.beats
        return total


@dataclass(frozen=True, slots=True)
class _Scale:
    """Breathing and beat variation of a study, as multiples of the parameters' values."""

    breathing: float = 1.0
    beats: float = 1.0

    @property
    def log_prior(self) -> float:
        return -0.5 * float(np.sum(np.log([self.breathing, self.beats]) ** 2)) / _SCALE_LOG_SD**2


_SCALES = tuple(_Scale(breathing, beats) for breathing in (1.0, 0.3, 0.1) for beats in (1.0, 0.3, 0.1))


@dataclass(frozen=True, eq=False)
class _GantryKind:
    """One kind of gantry: its probability, its prior (12, 12), and the heart's scale under it."""

    weight: float
    prior: Array
    scale: _Scale


def calibrate(
    sites: Sequence[tuple[Cameras, TwoViewPixels]],
    catalogue: Catalogue,
    trusted: frozenset[str],
    params: UncertaintyParams,
) -> tuple[Calibration | None, GantryBelief]:
    """Estimate the gantry's error from all sites, and decide whether to apply it.

    The six unknowns are a rotation of view b about the isocentre (prior 1 degree) and its offset (prior 2 mm). The data
    are the signed epipolar distance of every electrode and the catalogue's spacings. The header is kept unless both hold:
    the epipolar RMS exceeds 1.3 times the pixel noise, and the odds for a wrong gantry against breathing and beats
    exceed 20 to 1.

    Parameters
    ----------
    sites : sequence
        Nominal cameras and diastolic pixels of sites taken with the same two gantry positions.
    trusted : frozenset of str
        Catheters whose spacings agree with the catalogue's.

    Returns
    -------
    tuple
        The calibration for the report (None with fewer than three sites), and the belief that locates the sites.
    """
    header = GantryBelief(np.eye(4), params.gantry_covariance())
    if len(sites) < FEWEST_SITES:
        return None, header
    rows = _study_equations(sites, np.eye(4), catalogue, trusted, params)
    # Each hypothesis first chooses the breathing and beat variation that suits it, so that the comparison is fair.
    right = max(_evidence(rows, None, scale) for scale in _SCALES)
    wrong, scale = max(((_evidence(rows, GANTRY_PRIOR, scale), scale) for scale in _SCALES), key=lambda one: one[0])
    before = _epipolar_rms_px(rows, _posterior(rows, GANTRY_PRIOR, np.zeros(12), scale)[1], params, scale)
    noise = float(np.sqrt(np.mean(np.concatenate([one.pixel_variance for one in rows]))))
    if before <= GATE_EPIPOLAR_RATIO * noise or wrong - right <= GATE_LOG_ODDS:
        return Calibration(False, np.zeros(3), np.zeros(3), before, before), header
    kinds = _gantry_kinds(rows, header.covariance)
    covariance, mean = _posterior_over_kinds(rows, kinds, np.zeros(12))
    found = np.zeros(6)
    for _ in range(_STEPS):
        found = mean[6:] - mean[:6]
        rows = _study_equations(sites, _turn(found), catalogue, trusted, params)
        covariance, mean = _posterior_over_kinds(rows, kinds, np.concatenate([np.zeros(6), found]))
    # View b takes the whole difference. An error that both views share is a displacement of the world, which is free.
    left = np.concatenate([mean[:6], mean[6:] - found])
    belief = GantryBelief(_turn(found), covariance + np.outer(left, left))
    after = _epipolar_rms_px(rows, left, params, scale)
    if float((found**2 / (2 * np.diagonal(GANTRY_PRIOR)[6:])).sum()) > FARTHEST_CHI2 or _misfit(rows) > STILL_MISFIT:
        # Something else is wrong, such as a mirrored image or runs of another study. The sites report doubtful geometry.
        return Calibration(False, np.zeros(3), np.zeros(3), before, before), header
    return Calibration(True, np.degrees(found[:3]), found[3:], before, after), belief


def _turn(six: Array) -> Array:
    """Return the displacement (4, 4) ``X' = R X + t`` of a rotation vector (radians) and an offset (mm)."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(six[:3]).as_matrix()
    turn[:3, 3] = six[3:]
    return turn


def _study_equations(
    sites: Sequence[tuple[Cameras, TwoViewPixels]],
    turn: Array,
    catalogue: Catalogue,
    trusted: frozenset[str],
    params: UncertaintyParams,
) -> list[_SiteEquations]:
    return [
        _site_equations((nominal[0], displaced_camera(nominal[1], turn)), pixels, catalogue, trusted, params)
        for nominal, pixels in sites
    ]


def _site_equations(
    cameras: Cameras, pixels: TwoViewPixels, catalogue: Catalogue, trusted: frozenset[str], params: UncertaintyParams
) -> _SiteEquations:
    """Return a site's equations: epipolar distances, then electrode spacings."""
    points = triangulate_maximum_likelihood(*cameras, *pixels.pixels, *pixels.covariances)
    n = len(points)
    combine = epipolar_rows(cameras, points)
    residual = combine @ pixels.residuals_px(cameras, points)
    known = [
        (i, j, gap) for i, j, gap in neighbours(pixels.labels, catalogue) if pixels.labels[i][0] in trusted
    ]  # fmt: skip
    if known:
        first, second = (np.array([row[k] for row in known], dtype=np.intp) for k in (0, 1))
        apart = points[first] - points[second]
        length = np.linalg.norm(apart, axis=1)
        gain = separate_gain(cameras, points).reshape(n, 3, 4 * n)
        lengths = np.einsum("ka,kap->kp", apart / length[:, None], gain[first] - gain[second])
        combine = np.concatenate([combine, lengths])
        residual = np.concatenate([residual, length - [gap for *_, gap in known]])
    sources = error_sources(cameras, points, pixels.labels, catalogue, params, np.zeros((12, 12)), None)
    noise = pixel_noise_px2(pixels.covariances)
    fixed = combine @ noise @ combine.T
    fixed[range(n, len(residual)), range(n, len(residual))] += _SPACING_SD_MM**2
    # The gantry's own sources are the unknowns. A wrong source distance acts as an offset along the ray, one of them.
    parts = {share: np.zeros_like(fixed) for share in _SCALED}
    for source in sources:
        for share in parts.keys() & source.shares:
            effect = combine @ source.effect_px
            parts[share] += effect @ source.covariance @ effect.T
    jacobian = jacobians(cameras, points)
    return _SiteEquations(
        residual, combine @ gantry_effect_px(jacobian, points), fixed, parts["breathing"], parts["phase_mismatch"],
        combine @ breathing_effect_px(jacobian), n, np.diagonal(fixed)[:n],
    )  # fmt: skip


def _normal(rows: Sequence[_SiteEquations], linearised_at: Array, scale: _Scale) -> tuple[Array, Array]:
    """Return the information (12, 12) on the gantry and the weighted residual (12,) of all sites."""
    information, weighted = np.zeros((12, 12)), np.zeros(12)
    for one in rows:
        gain = np.linalg.solve(one.covariance(scale), one.slope).T
        information += gain @ one.slope
        weighted += gain @ (one.residual + one.slope @ linearised_at)
    return information, weighted


def _evidence(rows: Sequence[_SiteEquations], prior: Array | None, scale: _Scale) -> float:
    """Return the study's log likelihood, up to a constant.

    The gantry's errors are drawn from ``prior``; with None the gantry has no error.
    """
    evidence = scale.log_prior
    for one in rows:
        covariance = one.covariance(scale)
        evidence -= 0.5 * float(one.residual @ np.linalg.solve(covariance, one.residual))
        evidence -= 0.5 * float(np.linalg.slogdet(covariance)[1])
    if prior is not None:
        information, weighted = _normal(rows, np.zeros(12), scale)
        volume = np.linalg.slogdet(np.eye(12) + prior @ information)[1]
        mean = prior @ np.linalg.solve(np.eye(12) + information @ prior, weighted)
        evidence += 0.5 * float(weighted @ mean) - 0.5 * float(volume)
    return evidence


def _posterior(
    rows: Sequence[_SiteEquations], prior: Array, linearised_at: Array, scale: _Scale
) -> tuple[Array, Array]:
    """Return covariance (12, 12) and mean (12,) of the gantry's errors against the header.

    The equations were linearised at the errors ``linearised_at`` (12,).
    """
    information, weighted = _normal(rows, linearised_at, scale)
    # prior (1 + information prior)^-1 needs no inverse of a prior that may be 0.
    covariance: Array = np.asarray(prior @ np.linalg.inv(np.eye(12) + information @ prior), dtype=np.float64)
    return covariance, covariance @ weighted


def _gantry_kinds(rows: Sequence[_SiteEquations], assumed: Array) -> tuple[_GantryKind, ...]:
    """Return two kinds of gantry with their posterior probabilities.

    One kind has the errors that the parameters assume, covariance ``assumed`` (12, 12); the other has larger ones. No
    electrode shows an error that both views share, so each kind keeps its own prior there.
    """
    shares = ((1 - WORSE_SHARE, assumed), (WORSE_SHARE, GANTRY_PRIOR))
    found = [
        max(
            ((_evidence(rows, prior, scale) + np.log(share), prior, scale) for scale in _SCALES), key=lambda one: one[0]
        )
        for share, prior in shares
    ]
    most = max(odds for odds, *_ in found)
    weights = np.exp([odds - most for odds, *_ in found])
    weights /= weights.sum()
    return tuple(_GantryKind(float(w), prior, scale) for w, (_, prior, scale) in zip(weights, found, strict=True))


def _posterior_over_kinds(
    rows: Sequence[_SiteEquations], kinds: Sequence[_GantryKind], linearised_at: Array
) -> tuple[Array, Array]:
    """Return covariance and mean as :func:`_posterior`, over all kinds of gantry."""
    answers = [_posterior(rows, kind.prior, linearised_at, kind.scale) for kind in kinds]
    mean = np.sum([kind.weight * own for kind, (_, own) in zip(kinds, answers, strict=True)], axis=0)
    parts = [
        kind.weight * (covariance + np.outer(own - mean, own - mean))
        for kind, (covariance, own) in zip(kinds, answers, strict=True)
    ]
    return np.sum(parts, axis=0), mean


def _misfit(rows: Sequence[_SiteEquations]) -> float:
    """Return the mean squared misfit per equation.

    It is 1 where pixels, breathing and beats explain it.
    """
    total = sum(float(one.residual @ np.linalg.solve(one.covariance(_Scale()), one.residual)) for one in rows)
    return total / sum(len(one.residual) for one in rows)


def _epipolar_rms_px(rows: Sequence[_SiteEquations], gantry: Array, params: UncertaintyParams, scale: _Scale) -> float:
    """Return the Sampson RMS over the study, without each site's breathing.

    The breathing is estimated as if the gantry's errors were ``gantry`` (12,).
    """
    left = []
    prior = scale.breathing**2 * params.respiration_covariance_mm2() / 2
    for one in rows:
        k = slice(one.epipolar)
        unexplained = one.residual[k] - one.slope[k] @ gantry
        breath = prior @ one.breath[k].T @ np.linalg.solve(one.covariance(scale)[k, k], unexplained)
        left.append(one.residual[k] - one.breath[k] @ breath)
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
