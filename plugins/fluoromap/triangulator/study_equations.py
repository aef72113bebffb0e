"""Linear equations of a study for its gantry's errors and its catheters' gaps, and their evidence.

Each site gives ``r = S g + E gamma + e``: r are its epipolar distances (px) and electrode gaps (mm), g the gantry's errors,
gamma the errors of the catalogue's gaps, and e pixel noise, breathing and beats. g and gamma are the same at all sites.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array
from fluoromap.triangulator.beat_scatter import BeatScatter
from fluoromap.triangulator.error_sources import (
    ErrorSource,
    beat_sources,
    bend_covariances_px2,
    breathing_effect_px,
    breathing_sources,
    gantry_effect_px,
    jacobians,
    pixel_noise_px2,
)
from fluoromap.triangulator.estimate import separate_gain, triangulate_unweighted
from fluoromap.triangulator.spacing import neighbours
from fluoromap.triangulator.stray_electrodes import epipolar_rows
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels
from fluoromap.triangulator.uncertainty import UncertaintyParams

GANTRY_UNKNOWNS = 14
GAP_SD_MM = 0.3
"""Error of a catalogue's gap, the same at all sites: bent shafts, tip centres, wrong descriptions."""
_SPACING_SD_MM = 0.1
"""Difference of a gap between sites."""
_BREATHING_LOG_SD, _BEATS_LOG_SD = 1.1, 0.7
_BREATHING = (0.07, 0.15, 0.3, 0.55, 1.0, 1.6)
_BEATS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.5, 2.4)
_SIMULTANEOUS_SHARE = 0.1
"""Share of the studies whose two views are recorded at the same time."""


@dataclass(frozen=True, slots=True)
class HeartScale:
    """A study's breathing and beat variation, as multiples of the parameters' values.

    simultaneous : the two views are recorded at the same time. Then a site whose frames show the same beat shows nothing about
    other beats.
    """

    breathing: float = 1.0
    beats: float = 1.0
    simultaneous: bool = False

    @property
    def log_prior(self) -> float:
        """Logarithm of the log-normal prior density, up to a constant."""
        beats = -0.5 * float(np.log(self.beats) / _BEATS_LOG_SD) ** 2
        if self.simultaneous:
            return beats + _SIMULTANEOUS_LOG_WEIGHT
        return beats + _log_density_of_breathing(self.breathing)


def _log_density_of_breathing(breathing: float) -> float:
    return -0.5 * float(np.log(breathing) / _BREATHING_LOG_SD) ** 2


_SIMULTANEOUS_LOG_WEIGHT = float(
    np.log(_SIMULTANEOUS_SHARE / (1 - _SIMULTANEOUS_SHARE))
    + np.log(np.sum([np.exp(_log_density_of_breathing(breathing)) for breathing in _BREATHING]))
)
HEART_SCALES = (
    *(HeartScale(breathing, beats) for breathing in _BREATHING for beats in _BEATS),
    *(HeartScale(min(_BREATHING), beats, simultaneous=True) for beats in _BEATS),
)
"""Hearts of which one is the study's. Breathing displaces nothing between views that are recorded at the same time."""


@dataclass(frozen=True, eq=False)
class CalibrationSite:
    """All that a site says about gantry and heart.

    cameras : nominal. pixels : at diastole. same_beat : whether the two frames show the same beat if the views are simultaneous.
    scatter : of the beats in its runs.
    """

    cameras: Cameras
    pixels: TwoViewPixels
    same_beat: bool = False
    scatter: tuple[BeatScatter, ...] = ()


@dataclass(frozen=True, eq=False)
class SiteEquations:
    """One site's k equations ``residual = slope x + error`` for the u unknowns x: gantry, then gaps.

    The first ``epipolar`` equations are epipolar distances in px, the others electrode gaps in mm.

    residual : (k,). slope : (k, u). fixed : (k, k) covariance of the error from pixels and from the gaps' scatter.
    breathing, beats : (k, p) and (k, q) effects of breathing and of beats, one standard deviation of each of their independent
    parameters. breath : (k, 3) effect of breathing, an mm.
    pixel_variance : (epipolar,) px^2. same_beat : whether the frames show the same beat if the views were simultaneous.
    """

    residual: Array
    slope: Array
    fixed: Array
    breathing: Array
    beats: Array
    breath: Array
    epipolar: int
    pixel_variance: Array
    same_beat: bool

    def shows_beats(self, scale: HeartScale) -> bool:
        """Return False where both views show the same moment of such a heart."""
        return not (scale.simultaneous and self.same_beat)

    def covariance(self, scale: HeartScale) -> Array:
        """Return the covariance (k, k) of the error in a heart of this scale."""
        if not self.shows_beats(scale):
            return self.fixed
        of_breathing, of_beats = scale.breathing * self.breathing, scale.beats * self.beats
        total: Array = self.fixed + of_breathing @ of_breathing.T + of_beats @ of_beats.T
        return total


@dataclass(frozen=True, eq=False)
class Information:
    """All that a study's equations say about the unknowns in a heart of one scale.

    matrix : (u, u). vector : (u,). constant : log likelihood without the unknowns.
    """

    scale: HeartScale
    matrix: Array
    vector: Array
    constant: float

    def posterior(self, prior: Array) -> tuple[Array, Array]:
        """Return covariance (u, u) and mean (u,) of the unknowns."""
        # prior (1 + matrix prior)^-1 needs no inverse of a prior that may be 0.
        covariance: Array = np.asarray(prior @ np.linalg.inv(np.eye(len(prior)) + self.matrix @ prior))
        return covariance, covariance @ self.vector


def gap_labels(catalogue: Catalogue, trusted: frozenset[str]) -> tuple[tuple[str, int, int], ...]:
    """Return the gaps (catheter, electrode, next electrode) of the trusted catheters."""
    return tuple(
        (name, number, number + 1)
        for name in catalogue.names
        if name in trusted
        for number in range(1, catalogue[name].electrodes)
    )


def site_equations(
    site: CalibrationSite,
    cameras: Cameras,
    catalogue: Catalogue,
    gaps: Sequence[tuple[str, int, int]],
    params: UncertaintyParams,
) -> SiteEquations:
    """Return a site's equations with these cameras.

    Epipolar distances come first, then those of the ``gaps`` that the site shows.
    """
    pixels = site.pixels
    points = triangulate_unweighted(cameras, pixels)
    n = len(points)
    combine = epipolar_rows(cameras, points)
    residual = combine @ pixels.residuals_px(cameras, points)
    known = []
    for i, j, gap in neighbours(pixels.labels, catalogue):
        label = (pixels.labels[i][0], pixels.labels[i][1], pixels.labels[j][1])
        if label in gaps:
            known.append((i, j, gap, list(gaps).index(label)))
    errors = np.zeros((n + len(known), len(gaps)))
    if known:
        first, second = (np.array([row[k] for row in known], dtype=np.intp) for k in (0, 1))
        apart = points[first] - points[second]
        length = np.linalg.norm(apart, axis=1)
        gain = separate_gain(cameras, points).reshape(n, 3, 4 * n)
        lengths = np.einsum("ka,kap->kp", apart / length[:, None], gain[first] - gain[second])
        combine = np.concatenate([combine, lengths])
        residual = np.concatenate([residual, length - [gap for _, _, gap, _ in known]])
        errors[n + np.arange(len(known)), [row[3] for row in known]] = 1.0
    jacobian = jacobians(cameras, points)

    def combined(sources: Sequence[ErrorSource]) -> Array:
        # Breathing and beats have independent parameters.
        each = [combine @ (source.effect_px * np.sqrt(np.diagonal(source.covariance))) for source in sources]
        return np.concatenate(each, axis=1)

    noise = pixel_noise_px2(pixels.covariances)
    # An electrode's own bend is no beat. Where pixels are known well, it would hide how far whole catheters move.
    bend = pixel_noise_px2(bend_covariances_px2(jacobian, params))
    fixed = combine @ (noise + bend) @ combine.T
    fixed[range(n, len(residual)), range(n, len(residual))] += _SPACING_SD_MM**2
    breathing = combined(breathing_sources(jacobian, params))
    beats = combined(beat_sources(jacobian, points, pixels.labels, catalogue, params))
    slope = np.concatenate([combine @ gantry_effect_px(cameras, jacobian, points), errors], axis=1)
    return SiteEquations(
        residual, slope, fixed, breathing, beats, combine @ breathing_effect_px(jacobian), n,
        np.diagonal(combine @ noise @ combine.T)[:n], site.same_beat,
    )  # fmt: skip


def scatter_log_likelihoods(sites: Sequence[CalibrationSite], params: UncertaintyParams) -> Array:
    """Return the log likelihoods (h,) of all hearts from beats in single runs."""
    beats_sd_mm = params.beat_sd_mm * np.array([scale.beats for scale in HEART_SCALES])
    likelihoods = np.zeros(len(HEART_SCALES))
    for site in sites:
        for run in site.scatter:
            likelihoods += run.log_likelihood(beats_sd_mm)
    return likelihoods


def information(rows: Sequence[SiteEquations], linearised_at: Array, log_likelihoods: Array) -> list[Information]:
    """Return what the equations say, for each scale of the heart.

    The equations were linearised at the unknowns ``linearised_at`` (u,). ``log_likelihoods`` (h,) of the hearts come from other
    data.
    """
    u = len(linearised_at)
    constants = np.array(log_likelihoods)
    products = np.zeros((len(HEART_SCALES), u + 1, u + 1))
    alike: dict[tuple[bool, tuple[int, ...], tuple[int, ...]], list[SiteEquations]] = {}
    for one in rows:
        alike.setdefault((one.same_beat, one.slope.shape, one.beats.shape), []).append(one)
    for (same_beat, *_), of_shape in alike.items():
        in_hearts = _in_hearts(_products(of_shape, linearised_at))
        for heart, scale in enumerate(HEART_SCALES):
            if scale.simultaneous and same_beat:
                of_heart = in_hearts.still, in_hearts.still_constant
            else:
                place = _BREATHING.index(scale.breathing), _BEATS.index(scale.beats)
                of_heart = in_hearts.moving[place], in_hearts.moving_constants[place]
            products[heart] += of_heart[0]
            constants[heart] += of_heart[1] - 0.5 * of_heart[0][-1, -1]
    return [
        Information(scale, product[:-1, :-1], product[:-1, -1], float(constant))
        for scale, product, constant in zip(HEART_SCALES, products, constants, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class _SiteProducts:
    """Products of one site's equations, whose errors from pixels were made independent, with variance 1.

    With k equations, m columns (unknowns and residual), p parameters of breathing, q of beats, and for each of b breathings:

    still : (m, m). log_pixels : (k,), minus their sum is the log likelihood without columns. moving : (b, m, m) without breathing.
    log_breathing : (b, p). strengths : (b, q), in the axes of the beats' own products, where each of their parameters is separate
    from the others. along : (b, q, m), the products of beats and columns in these axes.
    """

    still: Array
    log_pixels: Array
    moving: Array
    log_breathing: Array
    strengths: Array
    along: Array


_at_header: WeakKeyDictionary[SiteEquations, _SiteProducts] = WeakKeyDictionary()
"""The products of equations that were linearised at the header. A correction changes the equations of one site of a study."""


def _products(rows: Sequence[SiteEquations], linearised_at: Array) -> list[_SiteProducts]:
    """Return the products of sites whose equations have the same shapes."""
    if linearised_at.any():
        return _computed_products(rows, linearised_at)
    unknown = [one for one in rows if one not in _at_header]
    if unknown:
        _at_header.update(zip(unknown, _computed_products(unknown, linearised_at), strict=True))
    return [_at_header[one] for one in rows]


def _computed_products(rows: Sequence[SiteEquations], linearised_at: Array) -> list[_SiteProducts]:
    """Compute the products of sites whose equations have the same shapes.

    Breathing and beats have few parameters. The matrix inversion lemma takes them out of the products of all hearts; it inverts
    small matrices only.
    """
    columns = np.array([
        np.column_stack([one.slope, one.residual + one.slope @ linearised_at, one.breathing, one.beats])
        for one in rows
    ])  # fmt: skip
    factor = np.linalg.cholesky(np.array([one.fixed for one in rows]))
    whitened = np.linalg.solve(factor, columns)
    log_pixels = np.log(np.diagonal(factor, axis1=-2, axis2=-1))
    products = np.swapaxes(whitened, -1, -2) @ whitened
    p, q = rows[0].breathing.shape[1], rows[0].beats.shape[1]
    kept = products.shape[-1] - p - q
    breathing = np.arange(kept, kept + p)
    others = np.r_[0:kept, kept + p : kept + p + q]
    of_breathing = products[:, breathing[:, None], breathing]
    across, of_others = products[:, breathing[:, None], others], products[:, others[:, None], others]
    sites, b = len(rows), len(_BREATHING)
    moving, along = np.empty((sites, b, kept, kept)), np.empty((sites, b, q, kept))
    log_breathing, strengths = np.empty((sites, b, p)), np.empty((sites, b, q))
    for row, breath in enumerate(_BREATHING):
        factor = np.linalg.cholesky(np.eye(p) + breath**2 * of_breathing)
        taken = np.linalg.solve(factor, breath * across)
        left = of_others - np.swapaxes(taken, -1, -2) @ taken
        log_breathing[:, row] = np.log(np.diagonal(factor, axis1=-2, axis2=-1))
        moving[:, row] = left[:, :kept, :kept]
        strengths[:, row], axes = np.linalg.eigh(left[:, kept:, kept:])
        along[:, row] = np.swapaxes(axes, -1, -2) @ left[:, kept:, :kept]
    still = products[:, :kept, :kept].copy()
    return [_SiteProducts(*of) for of in zip(still, log_pixels, moving, log_breathing, strengths, along, strict=True)]


@dataclass(frozen=True, eq=False)
class _InHearts:
    """Products (u + 1, u + 1) of unknowns and residual, summed over sites, and log likelihoods without both.

    still, still_constant : where both views show the same moment. moving, moving_constants : (breathing, beats, ...) of every
    heart's breathing and beats.
    """

    still: Array
    still_constant: float
    moving: Array
    moving_constants: Array


def _in_hearts(sites: Sequence[_SiteProducts]) -> _InHearts:
    """Return the products of all sites for all hearts."""
    still = np.array([one.still for one in sites]).sum(axis=0)
    still_constant = -float(np.array([one.log_pixels for one in sites]).sum())
    kept = len(still)
    of_moving, log_breathing, every_strength, every_along = (
        np.array([getattr(one, name) for one in sites]) for name in ("moving", "log_breathing", "strengths", "along")
    )
    moving = np.empty((len(_BREATHING), len(_BEATS), kept, kept))
    constants = np.empty((len(_BREATHING), len(_BEATS)))
    for row in range(len(_BREATHING)):
        constant = still_constant - log_breathing[:, row].sum()
        total = of_moving[:, row].sum(axis=0)
        strengths, along = every_strength[:, row], every_along[:, row].reshape(-1, kept)
        for column, beat in enumerate(_BEATS):
            growth = 1 + beat**2 * strengths
            weighted = along * (beat**2 / growth).reshape(-1, 1)
            moving[row, column] = total - along.T @ weighted
            constants[row, column] = constant - 0.5 * np.log(growth).sum()
    return _InHearts(still, still_constant, moving, constants)


def log_evidences(hearts: Sequence[Information], prior: Array) -> Array:
    """Return the log evidence (h,) of each heart, up to a constant.

    The unknowns are drawn from ``prior`` (u, u).
    """
    matrices, vectors = np.array([heart.matrix for heart in hearts]), np.array([heart.vector for heart in hearts])
    each = np.eye(len(prior)) + matrices @ prior
    means = (prior @ np.linalg.solve(each, vectors[..., None]))[..., 0]
    own = np.array([heart.constant + heart.scale.log_prior for heart in hearts])
    # det(1 + prior matrix) = det(1 + matrix prior)
    evidences: Array = own + 0.5 * (vectors * means).sum(axis=1) - 0.5 * np.linalg.slogdet(each)[1]
    return evidences
