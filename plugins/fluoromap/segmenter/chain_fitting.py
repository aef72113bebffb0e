"""Fit of linked chains to the image: positions, order and kind of their electrodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, BoolArray, Chain
from fluoromap.segmenter.chain_search import MANY_ELECTRODES, TURNING_ELECTRODES
from fluoromap.segmenter.linking import (
    CandidateChain,
    CatheterFamily,
    ShaftImage,
    kind_probabilities,
    shaft_evidence,
    shape_fit,
)
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.proposals import answers_for_each
from fluoromap.segmenter.refinement import LEAST_GAP, ElectrodeFit, predict_on_curve, refine
from fluoromap.segmenter.shaft_ends import shaft_beyond_ends

_SHAFT_WEIGHT = 1.0
_ENDS_WEIGHT = 3.0
_TIP_WEIGHT, _SHORT_TIP_WEIGHT, _MOST_TIP = 1.0, 0.5, 4.0
_LONG_TIP_MM, _MOST_BANDS = 3.0, 1.0
"""Tips that are longer than rings for certain, and how much the bands of shorter ones say: makers' tips differ."""
_TIP_SHARE = 0.25
"""Log-odds of the tip for one of log-likelihood: its signs are not independent, and the frames of a run go wrong together."""
HIDING_MM = 1.2
"""An electrode of another catheter hides what is nearer to it."""
_NEAR_MM, _NEAR_FACTOR = 3.0, 2.5
_MERGED_MM, _MERGED_SD_MM = 1.5, 0.8


@dataclass(frozen=True, slots=True)
class FittedChain:
    """A chain with the score of linking, and its clearness.

    clearness : how clearly its electrodes look like electrodes, see
    :attr:`~fluoromap.segmenter.refinement.ElectrodeFit.clearness`.
    """

    chain: Chain
    clearness: float


def fit_chains(
    x: Image,
    candidates_uv: Array,
    linked: Sequence[CandidateChain],
    shaft_image: ShaftImage,
    families: tuple[CatheterFamily, ...],
    noise: float,
    sure: int | None = None,
    tip_logits_at: Callable[[Array], Array] | None = None,
    is_seen: BoolArray | None = None,
) -> tuple[FittedChain, ...]:
    """Fit each chain with every catheter of as many electrodes.

    Each catheter is fitted in both orders. The catheter and the order with the highest likelihood win.

    Parameters
    ----------
    x : (rows, columns) float32
        Log image.
    candidates_uv : (n, 2)
        The candidates of the chains, pixels.
    linked : sequence of CandidateChain
    shaft_image : ShaftImage
    families : tuple of CatheterFamily
    noise : float
        Standard deviation of a pixel, log units, see
        :attr:`~fluoromap.segmenter.proposals.ImageEvidence.position_noise`.
    sure : int
        Number of candidates with a blob of their own; they come first. All by default.
    tip_logits_at : callable, optional
        (n, 2) pixels -> (n,) log-odds that electrodes there are tips. No end looks more like a tip by default.
    is_seen : (n,) bool, optional
        Which candidates lie in the field. The others stay where they are. All by default.

    Returns
    -------
    tuple of FittedChain
        In the order of ``linked``.
    """
    likelihood = np.full((len(linked), len(families)), -np.inf)
    foreign = _candidates_of_others(candidates_uv, linked, families)
    electrode_fits: dict[tuple[int, int], tuple[ElectrodeFit, int, float]] = {}
    for column, family in enumerate(families):
        rows = [row for row, chain in enumerate(linked) if len(chain.candidates) == family.catheter.electrodes]
        if not rows:
            continue
        order = np.array([linked[row].candidates for row in rows])
        hidden = np.array([[candidate in foreign[row] for candidate in linked[row].candidates] for row in rows])
        order, hidden = (np.concatenate([forth, forth[:, ::-1]]) for forth in (order, hidden))
        outside = np.zeros_like(hidden) if is_seen is None else ~is_seen[order]
        without_blob = np.zeros_like(hidden) if sure is None else order >= sure
        electrode_fit = refine(
            x, candidates_uv[order], family.catheter, shaft_image.px_per_mm, noise, hidden | outside, without_blob
        )
        electrode_fit = _apart(electrode_fit, candidates_uv[order], family.catheter, shaft_image.px_per_mm)
        electrode_fit = _with_places(electrode_fit, candidates_uv[order], outside)
        no_variance = np.zeros(order.shape)
        bands = electrode_fit.log_likelihood
        fit = bands + shape_fit(electrode_fit.points_uv, no_variance, family.catheter, shaft_image.px_per_mm)
        fit += _SHAFT_WEIGHT * shaft_evidence(electrode_fit.points_uv, family.catheter, shaft_image)
        directed = fit + _ENDS_WEIGHT * shaft_beyond_ends(electrode_fit.points_uv, family.catheter, shaft_image)
        if tip_logits_at is not None:
            first, last = answers_for_each(tip_logits_at, [electrode_fit.points_uv[:, end] for end in (0, -1)])
            weight = _TIP_WEIGHT if _tip_shows(family.catheter) else _SHORT_TIP_WEIGHT
            directed += weight * np.clip(first - last, -_MOST_TIP, _MOST_TIP)
        for index, row in enumerate(rows):
            back = index + len(rows)
            forth_over_back = float(directed[index] - directed[back])
            if family.catheter.tip_mm < _LONG_TIP_MM:
                of_bands = float(bands[index] - bands[back])
                forth_over_back += float(np.clip(of_bands, -_MOST_BANDS, _MOST_BANDS)) - of_bands
            best = index if forth_over_back >= 0 else index + len(rows)
            likelihood[row, column] = fit[best]
            electrode_fits[row, column] = electrode_fit, best, _TIP_SHARE * abs(forth_over_back)
    probabilities = kind_probabilities(likelihood, families)
    chains = []
    for row, chain in enumerate(linked):
        of_family = [
            sum(probability for name, probability in probabilities[row] if name in family.names) for family in families
        ]
        electrode_fit, best, tip_odds = (
            electrode_fits.get((row, int(np.argmax(of_family)))) or electrode_fits[row, chain.family]
        )
        chains.append(
            FittedChain(
                Chain(
                    electrodes=tuple(range(1, len(chain.candidates) + 1)),
                    pixels_uv=electrode_fit.points_uv[best],
                    covariance_px2=electrode_fit.covariance_px2[best],
                    scores=np.full(len(chain.candidates), chain.score),
                    kinds=probabilities[row],
                    tip_odds=tip_odds,
                ),
                float(electrode_fit.clearness[best]),
            )
        )
    return tuple(chains)


def _apart(fit: ElectrodeFit, candidates_uv: Array, catheter: Catheter, px_per_mm: float) -> ElectrodeFit:
    """Return the fit without electrodes that it moved into the place of a neighbour.

    Of the two electrodes, the second to leave its candidate (chains, electrodes, 2) farther behind returns to it. The way between
    both places adds to its covariance.
    """
    gaps = np.linalg.norm(np.diff(fit.points_uv, axis=1), axis=2)
    meets = gaps < LEAST_GAP * px_per_mm * np.array(catheter.spacing_mm)
    if not meets.any():
        return fit
    moved = np.linalg.norm(fit.points_uv - candidates_uv, axis=2)
    second = moved[:, 1:] > moved[:, :-1]
    back = np.zeros(moved.shape, np.bool_)
    back[:, 1:] |= meets & second
    back[:, :-1] |= meets & ~second
    covariance = fit.covariance_px2 + np.where(back, moved**2, 0.0)[..., None, None] * np.eye(2)
    return replace(_with_places(fit, candidates_uv, back), covariance_px2=covariance)


def _with_places(fit: ElectrodeFit, places_uv: Array, there: BoolArray) -> ElectrodeFit:
    """Return the fit with some electrodes at these places (n, electrodes, 2)."""
    if not there.any():
        return fit
    return replace(fit, points_uv=np.where(there[..., None], places_uv, fit.points_uv))


def names_with_long_tips(catalogue: Catalogue) -> frozenset[str]:
    """Return the names of the catheters whose tips are longer than rings for certain."""
    return frozenset(catheter.name for catheter in catalogue.catheters if catheter.tip_mm >= _LONG_TIP_MM)


def _tip_shows(catheter: Catheter) -> bool:
    """Return whether the network can see well which end is the tip.

    The tip of a quadripolar catheter is as long as its rings.
    """
    return catheter.tip_mm >= _LONG_TIP_MM or catheter.electrodes >= MANY_ELECTRODES


def are_hidden(points_uv: Array, others: Sequence[Chain], px_per_mm: float) -> BoolArray:
    """Return which points (n, 2) lie behind electrodes of other catheters."""
    hidden = np.zeros(len(points_uv), np.bool_)
    for other in others:
        away = np.linalg.norm(points_uv[:, None] - other.pixels_uv[None], axis=2).min(axis=1)
        hidden |= away < HIDING_MM * px_per_mm
    return hidden


def widen_covariance(chain: Chain, others: Sequence[Chain], px_per_mm: float) -> Array:
    """Return the chain's covariances, widened near other electrodes.

    Bands that lie close together disturb each other's fit: those of other chains, and those of a long catheter that turns through
    the viewing direction, where several of its electrodes may be fitted to one dark place.
    """
    covariance = chain.covariance_px2
    if len(chain.electrodes) >= TURNING_ELECTRODES:
        apart = np.linalg.norm(chain.pixels_uv[:, None] - chain.pixels_uv, axis=2)
        np.fill_diagonal(apart, np.inf)
        merged = np.maximum(1.0 - apart.min(axis=1) / (_MERGED_MM * px_per_mm), 0.0)
        covariance = covariance + ((_MERGED_SD_MM * px_per_mm * merged) ** 2)[:, None, None] * np.eye(2)
    if not others:
        return covariance
    beside = np.concatenate([other.pixels_uv for other in others])
    difference = chain.pixels_uv[:, None] - beside
    near = np.sqrt((difference * difference).sum(axis=2).min(axis=1)) < _NEAR_MM * px_per_mm
    return np.where(near[:, None, None], _NEAR_FACTOR, 1.0) * covariance


def _candidates_of_others(
    candidates_uv: Array, linked: Sequence[CandidateChain], families: Sequence[CatheterFamily]
) -> tuple[frozenset[int], ...]:
    """Return, for each chain, the shared candidates that fit another chain's curve better.

    Where two catheters cross, one blob may represent two electrodes and lie at the place of one of them.
    """
    foreign: list[set[int]] = [set() for _ in linked]
    for row, chain in enumerate(linked):
        for other in range(row):
            for candidate in set(chain.candidates) & set(linked[other].candidates):
                away = [_distance_from_curve(candidates_uv, linked[one], families, candidate) for one in (row, other)]
                foreign[row if away[0] > away[1] else other].add(candidate)
    return tuple(frozenset(candidates) for candidates in foreign)


def _distance_from_curve(
    candidates_uv: Array, chain: CandidateChain, families: Sequence[CatheterFamily], candidate: int
) -> float:
    points = candidates_uv[list(chain.candidates)]
    covered = np.array([one == candidate for one in chain.candidates])
    if np.count_nonzero(~covered) < 2:
        return 0.0
    predicted = predict_on_curve(points, covered, families[chain.family].catheter.arc_lengths_mm)
    return float(np.linalg.norm(predicted - points[covered]))
