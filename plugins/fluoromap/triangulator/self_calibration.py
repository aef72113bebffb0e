"""What the electrodes of a whole study say about the gantry: how view b's camera was turned and shifted against the header.

Errors of the gantry are common to the study, breathing to one run of one site, a beat to one catheter in one run: from the
electrodes' epipolar distances over all sites the three are told apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Calibration
from fluoromap.geometry import Camera
from fluoromap.triangulator.estimate import alone_gain, triangulate_maximum_likelihood
from fluoromap.triangulator.spacing import neighbours
from fluoromap.triangulator.strays import epipolar_rows
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
"""How far view b's rotation and offset may be from view a's and the header's, an axis, before the electrodes are asked."""
GANTRY_PRIOR = np.diag(np.tile(np.repeat(np.square([np.radians(ROTATION_SD_DEG), OFFSET_SD_MM]), 3), 2)) / 2
"""Covariance (12, 12) of both views' errors, half of view b's against view a's each."""
WORSE_SHARE = 0.03
"""Share of gantries that are as wrong as that; the others are as the parameters say."""
OPENS_ABOVE = 1.3
"""Epipolar RMS over pixel noise below which the header is believed."""
OPENS_AT_ODDS = 3.0
"""Natural logarithm of the odds for a wrong gantry against a right one that opens the gate (20 to 1)."""
FEWEST_SITES = 3
FARTHEST_CHI2 = 22.46
"""99.9th percentile of chi-squared with 6 degrees of freedom: what lies farther from the header is no error of a gantry."""
STILL_MISFIT = 2.0
"""Misfit a row, 1 being what is expected, above which the calibrated gantry does not explain the electrodes either."""
_SPACING_SD_MM = 0.1
_STEPS = 4
_SCALED: tuple[Share, ...] = ("breathing", "phase_mismatch")
_SCALE_LOG_SD = 1.1


@dataclass(frozen=True, eq=False)
class GantryBelief:
    """What is known of the gantry after a study.

    camera_b_turn : (4, 4) displacement of the world as view b sees it; the identity where the header stands.
    covariance : (12, 12) of what is still wrong, see :func:`~fluoromap.triangulator.uncertainty.gantry_effect_px`.
    """

    camera_b_turn: Array
    covariance: Array

    def cameras(self, nominal: Cameras) -> Cameras:
        return nominal[0], turned(nominal[1], self.camera_b_turn)


def turned(camera: Camera, turn: Array) -> Camera:
    """The camera of a view that sees the world displaced by ``turn`` (4, 4)."""
    return Camera(camera.matrix @ turn, camera.rows, camera.columns)


@dataclass(frozen=True, eq=False)
class _Rows:
    """One site's k equations ``residual = slope g + error`` for the gantry's 12 unknowns g.

    residual : (k,). slope : (k, 12). fixed, breathing, beats : (k, k) covariances of the error from pixels and the like,
    from breathing and from beats. breath : (k, 3) what breathing does to them. epipolar : how many of the rows are
    epipolar distances, px; they come first. pixel_variance : (epipolar,) px^2.
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
    """How much of the breathing and of the beats' variation that the parameters assume this study shows."""

    breathing: float = 1.0
    beats: float = 1.0

    @property
    def log_prior(self) -> float:
        return -0.5 * float(np.sum(np.log([self.breathing, self.beats]) ** 2)) / _SCALE_LOG_SD**2


_SCALES = tuple(_Scale(breathing, beats) for breathing in (1.0, 0.3, 0.1) for beats in (1.0, 0.3, 0.1))


@dataclass(frozen=True, eq=False)
class _Kind:
    """One kind of gantry: how probable it is, (12, 12) how wrong such are, and what this heart does were it one."""

    weight: float
    prior: Array
    scale: _Scale


def calibrate(
    sites: Sequence[tuple[Cameras, TwoViewPixels]],
    catalogue: Catalogue,
    trusted: frozenset[str],
    params: UncertaintyParams,
) -> tuple[Calibration | None, GantryBelief]:
    """Estimate the gantry's error from all sites, and decide whether to believe it.

    Six unknowns, a rotation of view b about the isocentre (prior 1 degree) and its offset (prior 2 mm), from the signed
    epipolar distance of every electrode and from the catalogue's spacings. The header stands unless the epipolar RMS
    exceeds 1.3 times the pixel noise and the odds for a wrong gantry, rather than breathing and beats, are 20 to 1.

    Parameters
    ----------
    sites : sequence
        Nominal cameras and diastolic pixels of sites taken with the same two gantry positions.
    trusted : frozenset of str
        Catheters whose spacings agree with the catalogue's.

    Returns
    -------
    tuple
        What was found, None with fewer than three sites, and what to believe from then on.
    """
    header = GantryBelief(np.eye(4), params.gantry_covariance())
    if len(sites) < FEWEST_SITES:
        return None, header
    rows = _all_rows(sites, np.eye(4), catalogue, trusted, params)
    # How much this heart breathes and varies is judged under either hypothesis before the two are compared.
    right = max(_evidence(rows, None, scale) for scale in _SCALES)
    wrong, scale = max(((_evidence(rows, GANTRY_PRIOR, scale), scale) for scale in _SCALES), key=lambda one: one[0])
    before = _epipolar_rms_px(rows, _posterior(rows, GANTRY_PRIOR, np.zeros(12), scale)[1], params, scale)
    noise = float(np.sqrt(np.mean(np.concatenate([one.pixel_variance for one in rows]))))
    if before <= OPENS_ABOVE * noise or wrong - right <= OPENS_AT_ODDS:
        return Calibration(False, np.zeros(3), np.zeros(3), before, before), header
    kinds = _kinds(rows, header.covariance)
    covariance, mean = _over_kinds(rows, kinds, np.zeros(12))
    found = np.zeros(6)
    for _ in range(_STEPS):
        found = mean[6:] - mean[:6]
        rows = _all_rows(sites, _turn(found), catalogue, trusted, params)
        covariance, mean = _over_kinds(rows, kinds, np.concatenate([np.zeros(6), found]))
    # View b takes the whole difference: view a's own error, and the same one of view b, are those of the world they share.
    left = np.concatenate([mean[:6], mean[6:] - found])
    belief = GantryBelief(_turn(found), covariance + np.outer(left, left))
    after = _epipolar_rms_px(rows, left, params, scale)
    if float((found**2 / (2 * np.diagonal(GANTRY_PRIOR)[6:])).sum()) > FARTHEST_CHI2 or _misfit(rows) > STILL_MISFIT:
        # Something else is wrong: a mirrored image, runs of another study. The sites tell that their geometry is doubtful.
        return Calibration(False, np.zeros(3), np.zeros(3), before, before), header
    return Calibration(True, np.degrees(found[:3]), found[3:], before, after), belief


def _turn(six: Array) -> Array:
    """Displacement (4, 4) ``X' = R X + t`` of a rotation vector (radians) and an offset (mm)."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(six[:3]).as_matrix()
    turn[:3, 3] = six[3:]
    return turn


def _all_rows(
    sites: Sequence[tuple[Cameras, TwoViewPixels]],
    turn: Array,
    catalogue: Catalogue,
    trusted: frozenset[str],
    params: UncertaintyParams,
) -> list[_Rows]:
    return [
        _rows((nominal[0], turned(nominal[1], turn)), pixels, catalogue, trusted, params) for nominal, pixels in sites
    ]


def _rows(
    cameras: Cameras, pixels: TwoViewPixels, catalogue: Catalogue, trusted: frozenset[str], params: UncertaintyParams
) -> _Rows:
    """The part of a site's pixels that no point in space explains, and its electrodes' spacings."""
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
        gain = alone_gain(cameras, points).reshape(n, 3, 4 * n)
        lengths = np.einsum("ka,kap->kp", apart / length[:, None], gain[first] - gain[second])
        combine = np.concatenate([combine, lengths])
        residual = np.concatenate([residual, length - [gap for *_, gap in known]])
    sources = error_sources(cameras, points, pixels.labels, catalogue, params, np.zeros((12, 12)), None)
    noise = pixel_noise_px2(pixels.covariances)
    fixed = combine @ noise @ combine.T
    fixed[range(n, len(residual)), range(n, len(residual))] += _SPACING_SD_MM**2
    # The gantry's own sources are the unknowns; a wrong source distance acts as an offset along the ray, which is one.
    parts = {share: np.zeros_like(fixed) for share in _SCALED}
    for source in sources:
        for share in parts.keys() & source.shares:
            effect = combine @ source.effect_px
            parts[share] += effect @ source.covariance @ effect.T
    jacobian = jacobians(cameras, points)
    return _Rows(
        residual, combine @ gantry_effect_px(jacobian, points), fixed, parts["breathing"], parts["phase_mismatch"],
        combine @ breathing_effect_px(jacobian), n, np.diagonal(fixed)[:n],
    )  # fmt: skip


def _normal(rows: Sequence[_Rows], linearised_at: Array, scale: _Scale) -> tuple[Array, Array]:
    """Information (12, 12) on the gantry and the weighted residual (12,) of all sites."""
    information, weighted = np.zeros((12, 12)), np.zeros(12)
    for one in rows:
        gain = np.linalg.solve(one.covariance(scale), one.slope).T
        information += gain @ one.slope
        weighted += gain @ (one.residual + one.slope @ linearised_at)
    return information, weighted


def _evidence(rows: Sequence[_Rows], prior: Array | None, scale: _Scale) -> float:
    """Log likelihood of the study, but for a constant, with the gantry's errors drawn from a prior; None: with none."""
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


def _posterior(rows: Sequence[_Rows], prior: Array, linearised_at: Array, scale: _Scale) -> tuple[Array, Array]:
    """Covariance (12, 12) and mean (12,) of the gantry's errors against the header, from rows made at ``linearised_at``."""
    information, weighted = _normal(rows, linearised_at, scale)
    # prior (1 + information prior)^-1 needs no inverse of a prior that may be 0.
    covariance: Array = np.asarray(prior @ np.linalg.inv(np.eye(12) + information @ prior), dtype=np.float64)
    return covariance, covariance @ weighted


def _kinds(rows: Sequence[_Rows], assumed: Array) -> tuple[_Kind, ...]:
    """Gantries as the parameters assume them, (12, 12), and worse ones, as probable as the study makes them.

    What both views have wrong alike no electrode shows: there each kind's own prior remains.
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
    return tuple(_Kind(float(w), prior, scale) for w, (_, prior, scale) in zip(weights, found, strict=True))


def _over_kinds(rows: Sequence[_Rows], kinds: Sequence[_Kind], linearised_at: Array) -> tuple[Array, Array]:
    """Covariance and mean as :func:`_posterior`, over all kinds of gantry."""
    answers = [_posterior(rows, kind.prior, linearised_at, kind.scale) for kind in kinds]
    mean = np.sum([kind.weight * own for kind, (_, own) in zip(kinds, answers, strict=True)], axis=0)
    parts = [
        kind.weight * (covariance + np.outer(own - mean, own - mean))
        for kind, (covariance, own) in zip(kinds, answers, strict=True)
    ]
    return np.sum(parts, axis=0), mean


def _misfit(rows: Sequence[_Rows]) -> float:
    """Squared misfit a row over what pixels, breathing and beats explain as the parameters assume them."""
    total = sum(float(one.residual @ np.linalg.solve(one.covariance(_Scale()), one.residual)) for one in rows)
    return total / sum(len(one.residual) for one in rows)


def _epipolar_rms_px(rows: Sequence[_Rows], gantry: Array, params: UncertaintyParams, scale: _Scale) -> float:
    """Sampson RMS over the study, less each site's own breathing: what is left of it were the gantry wrong by ``gantry``."""
    left = []
    prior = scale.breathing**2 * params.respiration_covariance_mm2() / 2
    for one in rows:
        k = slice(one.epipolar)
        unexplained = one.residual[k] - one.slope[k] @ gantry
        breath = prior @ one.breath[k].T @ np.linalg.solve(one.covariance(scale)[k, k], unexplained)
        left.append(one.residual[k] - one.breath[k] @ breath)
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
