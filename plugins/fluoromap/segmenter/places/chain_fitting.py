"""Fit of linked chains to the image: positions, order and kind of their electrodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, BoolArray, Chain, IntArray
from fluoromap.segmenter.chains.families import CatheterFamily
from fluoromap.segmenter.chains.linking import CandidateChain, shaft_evidence
from fluoromap.segmenter.judge.features.shaft_ends import shaft_beyond_ends
from fluoromap.segmenter.judge.names import kind_probabilities
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.picture.shaft_image import ShaftImage
from fluoromap.segmenter.places import ellipse
from fluoromap.segmenter.places.cylinder_fit import compare_catheters
from fluoromap.segmenter.places.refinement import LEAST_GAP, ElectrodeFit, refine, usual_radius_mm
from fluoromap.segmenter.shape.curve import predict_on_curve
from fluoromap.segmenter.shape.limits import LONG_TIP_MM, MANY_ELECTRODES
from fluoromap.segmenter.shape.spacings import shape_fit

_SHAFT_WEIGHT = 1.0
_ENDS_WEIGHT = 3.0
_TIP_WEIGHT, _SHORT_TIP_WEIGHT, _MOST_TIP = 1.0, 0.5, 4.0
_MOST_OF_SHORT_TIP = 4.0
"""How much the image of short tips says at most: makers' tips differ."""
_TIP_SHARE = 0.25
"""Log-odds of the tip for one of log-likelihood: its signs are not independent, and the frames of a run go wrong together."""
HIDING_MM = 1.2
"""An electrode of another catheter hides what is nearer to it."""


@dataclass(frozen=True, slots=True)
class FittedChain:
    """A chain with the score of linking, and its clearness.

    clearness : how clearly its electrodes look like electrodes, see
    :attr:`~fluoromap.segmenter.places.refinement.ElectrodeFit.clearness`.
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
    """Fit each chain as the most probable catheter.

    It is compared with every catheter of as many electrodes, in both orders, as cylinders along the chain's line. The order with
    the highest likelihood wins.

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
        :attr:`~fluoromap.segmenter.electrodes.proposals.ImageEvidence.position_noise`.
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
    foreign = _candidates_of_others(candidates_uv, linked, families)
    judged: list[_Judged] = []
    for chain, of_others in zip(linked, foreign, strict=True):
        order = np.array(chain.candidates)
        hidden = np.isin(order, list(of_others))
        outside = np.zeros(len(order), np.bool_) if is_seen is None else ~is_seen[order]
        judged.append(
            _judge(x, candidates_uv, order, hidden, outside, shaft_image, families, tip_logits_at or _no_tips)
        )
    kinds = kind_probabilities(np.array([one.likelihood for one in judged]).reshape(-1, len(families)), families)
    chosen = [_most_probable(kinds[row], families, chain) for row, chain in enumerate(linked)]
    fitted: dict[int, FittedChain] = {}
    for family in set(chosen):
        rows = [row for row, other in enumerate(chosen) if other == family]
        turned = [judged[row].turned(family) for row in rows]
        catheter = families[family].catheter
        order, hidden, outside = (np.stack(parts) for parts in zip(*turned, strict=True))
        without_blob = np.zeros_like(hidden) if sure is None else order >= sure
        places = candidates_uv[order]
        electrodes = refine(x, places, catheter, shaft_image.px_per_mm, noise, hidden | outside, without_blob)
        electrodes = _with_places(_apart(electrodes, places, catheter, shaft_image.px_per_mm), places, outside)
        for index, row in enumerate(rows):
            fitted[row] = FittedChain(
                Chain(
                    electrodes=tuple(range(1, catheter.electrodes + 1)),
                    pixels_uv=electrodes.points_uv[index],
                    covariance_px2=electrodes.covariance_px2[index],
                    scores=np.full(catheter.electrodes, linked[row].score),
                    kinds=kinds[row],
                    tip_odds=_TIP_SHARE * abs(float(judged[row].forth_over_back[family])),
                ),
                float(electrodes.clearness[index]),
            )
    return tuple(fitted[row] for row in range(len(linked)))


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """A chain's names and order.

    order : its candidates. hidden, outside : (electrodes,) which of them are behind another catheter, or outside the field.
    likelihood : (families,) log-likelihood in the better order; -inf where a family has another number of electrodes.
    forth_over_back : (families,) how much more likely the chain's order is than the other one, log-likelihood.
    """

    order: IntArray
    hidden: BoolArray
    outside: BoolArray
    likelihood: Array
    forth_over_back: Array

    def turned(self, family: int) -> tuple[IntArray, BoolArray, BoolArray]:
        """Return order, hidden and outside from the tip on.

        ``family`` : of the catheter.
        """
        step = 1 if self.forth_over_back[family] >= 0 else -1
        return self.order[::step], self.hidden[::step], self.outside[::step]


def _judge(
    x: Image,
    candidates_uv: Array,
    order: IntArray,
    hidden: BoolArray,
    outside: BoolArray,
    shaft_image: ShaftImage,
    families: Sequence[CatheterFamily],
    tip_logits_at: Callable[[Array], Array],
) -> _Judged:
    """Compare a chain with every catheter of as many electrodes, in both orders."""
    alike = [index for index, family in enumerate(families) if family.catheter.electrodes == len(order)]
    catheters = [families[index].catheter for index in alike]
    radii_mm = [usual_radius_mm(catheter) for catheter in catheters]
    compared = compare_catheters(x, candidates_uv[order], catheters, shaft_image.px_per_mm, radii_mm, hidden | outside)
    ends_uv = compared.points_uv[:, :, [0, -1]]
    tip_logits = tip_logits_at(ends_uv.reshape(-1, 2)).reshape(ends_uv.shape[:-1])
    like_tip = np.clip(tip_logits[..., 0] - tip_logits[..., 1], -_MOST_TIP, _MOST_TIP)
    likelihood, forth_over_back = np.full(len(families), -np.inf), np.zeros(len(families))
    for row, (index, catheter) in enumerate(zip(alike, catheters, strict=True)):
        points, in_image = compared.points_uv[row], compared.log_likelihood[row]
        fit = in_image + shape_fit(points, np.zeros(points.shape[:2]), catheter, shaft_image.px_per_mm)
        fit += _SHAFT_WEIGHT * shaft_evidence(points, catheter, shaft_image)
        directed = fit + _ENDS_WEIGHT * shaft_beyond_ends(points, catheter, shaft_image)
        directed += (_TIP_WEIGHT if _tip_shows(catheter) else _SHORT_TIP_WEIGHT) * like_tip[row]
        forth = float(directed[0] - directed[1])
        if catheter.tip_mm < LONG_TIP_MM:
            of_image = float(in_image[0] - in_image[1])
            forth += float(np.clip(of_image, -_MOST_OF_SHORT_TIP, _MOST_OF_SHORT_TIP)) - of_image
        likelihood[index], forth_over_back[index] = fit[0 if forth >= 0 else 1], forth
    return _Judged(order, hidden, outside, likelihood, forth_over_back)


def _no_tips(points_uv: Array) -> Array:
    """Return the log-odds of tips where no network says more of them, (n,)."""
    return np.zeros(len(points_uv))


def _most_probable(
    kinds: Sequence[tuple[str, float]], families: Sequence[CatheterFamily], chain: CandidateChain
) -> int:
    """Return the index of the most probable family.

    It has as many electrodes as the linked chain.
    """
    of_family = [
        sum(probability for name, probability in kinds if name in family.names)
        if family.catheter.electrodes == len(chain.candidates)
        else -1.0
        for family in families
    ]
    return int(np.argmax(of_family))


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
    covariance = ellipse.returned(fit.covariance_px2, moved, back)
    return replace(_with_places(fit, candidates_uv, back), covariance_px2=covariance)


def _with_places(fit: ElectrodeFit, places_uv: Array, there: BoolArray) -> ElectrodeFit:
    """Return the fit with some electrodes at these places (n, electrodes, 2)."""
    if not there.any():
        return fit
    return replace(fit, points_uv=np.where(there[..., None], places_uv, fit.points_uv))


def names_with_long_tips(catalogue: Catalogue) -> frozenset[str]:
    """Return the names of the catheters whose tips are longer than rings for certain."""
    return frozenset(catheter.name for catheter in catalogue.catheters if catheter.tip_mm >= LONG_TIP_MM)


def _tip_shows(catheter: Catheter) -> bool:
    """Return whether the network can see well which end is the tip.

    The tip of a quadripolar catheter is as long as its rings.
    """
    return catheter.tip_mm >= LONG_TIP_MM or catheter.electrodes >= MANY_ELECTRODES


def are_hidden(points_uv: Array, others: Sequence[Chain], px_per_mm: float) -> BoolArray:
    """Return which points (n, 2) lie behind electrodes of other catheters."""
    hidden = np.zeros(len(points_uv), np.bool_)
    for other in others:
        away = np.linalg.norm(points_uv[:, None] - other.pixels_uv[None], axis=2).min(axis=1)
        hidden |= away < HIDING_MM * px_per_mm
    return hidden


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
