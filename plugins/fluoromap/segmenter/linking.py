"""Candidate electrodes -> chains that fit a catheter of the catalogue; the best set of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, IntArray
from fluoromap.segmenter import chain_scores, chain_search
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.proposals import log_odds

_EVIDENCE_LEAST, _EVIDENCE_MOST = -1.0, 2.2
_SHAFT_WEIGHT = 0.4
_SHARED = 1.5
_LOST = 2.0
_WORTH = 6.0
_BEST = 80
_SIDE_MM = 1.75
_SAME_PLACE_MM, _SAME_PLACES = 1.3, 3


@dataclass(frozen=True, slots=True, eq=False)
class Shafts:
    """Where shafts are looked for.

    smooth : the log image without most of its noise, ``reduction`` times smaller than the frame. clear : depth in log
    units that counts as a clear shaft. px_per_mm : of the frame, at the isocentre.
    """

    smooth: Image
    reduction: int
    clear: float
    px_per_mm: float

    @property
    def side_px(self) -> float:
        """How far beside a shaft its surroundings are looked at."""
        return max(2.0, _SIDE_MM * self.px_per_mm)


@dataclass(frozen=True, slots=True)
class Family:
    """Catheters that fluoroscopy cannot tell apart; at most ``len(names)`` chains of one frame belong to it."""

    names: tuple[str, ...]
    catheter: Catheter

    @property
    def floor(self) -> float:
        """Score below which a chain may be anatomy: two electrodes have no second spacing that could disagree."""
        return 1.0 if self.catheter.electrodes > 2 else 3.0


@dataclass(frozen=True, slots=True)
class Linked:
    """A chain of candidates. candidates : their indices from the tip on. family : index. score : higher is better."""

    candidates: tuple[int, ...]
    family: int
    score: float


def families(catalogue: Catalogue) -> tuple[Family, ...]:
    """The catalogue's catheters grouped by :meth:`~fluoromap.catheters.Catheter.looks_like`."""
    groups: list[list[Catheter]] = []
    for catheter in catalogue.catheters:
        for group in groups:
            if group[0].looks_like(catheter):
                group.append(catheter)
                break
        else:
            groups.append([catheter])
    return tuple(Family(tuple(member.name for member in group), group[0]) for group in groups)


@dataclass(frozen=True, slots=True)
class Trust:
    """What the log-odds of one candidate are worth beside those of its neighbours in a chain.

    share : 1 where candidates were judged one by one; less where the proposer saw the neighbours too, so that its errors go
    together. chain : added for each candidate, because candidates in a chain are electrodes more often than others.
    """

    share: float = 1.0
    chain: float = 0.0


def evidence(probability: Array, trust: Trust = Trust()) -> Array:  # noqa: B008 -- a frozen value
    """What a candidate adds to a chain's score: its log-odds, 0 for an even chance, from -1 to 2.2."""
    return np.clip(trust.chain + trust.share * log_odds(probability), _EVIDENCE_LEAST, _EVIDENCE_MOST)


def link(
    points_uv: Array,
    weights: Array,
    variance_px2: Array,
    shafts: Shafts,
    kinds: Sequence[Family],
    sure: int | None = None,
    slack: float = 0.0,
    completed: Sequence[IntArray] = (),
) -> tuple[Linked, ...]:
    """The best set of chains: ordered from the tip, at most as many of a family as the catalogue has.

    A chain's score is the sum of its candidates' weights, less penalties for spacings whose foreshortening differs by more
    than a bend in depth explains (0.06 SD), for bends (0.36 rad SD across the rays, more where foreshortened; S-bends count
    half more), for strong foreshortening and for rings of unlike weight,
    plus evidence of a dark shaft between the electrodes and behind the last but not before the tip.
    A set is worth its scores and 6 for each chain, so that a third, weaker catheter is not dropped; crossing catheters may
    share one candidate, at a price, but not stand in the same places.

    Parameters
    ----------
    points_uv : (n, 2)
        Candidates, pixels.
    weights : (n,)
        Their :func:`evidence`.
    variance_px2 : (n,)
        Of each coordinate of theirs.
    shafts : Shafts
    kinds : sequence of Family
    sure : int
        The first so many candidates are sound; others may make up half of a chain at most, at a price. All by default.
    slack : float
        How far below its family's floor a chain may lie.
    completed : sequence of (n, electrodes) int
        More chains of each family, as indices from the tip on; then the others are made of the sound candidates only.

    Returns
    -------
    tuple of Linked
        Best first.
    """
    sure = len(points_uv) if sure is None else sure
    points = np.ascontiguousarray(points_uv, dtype=np.float64)
    found: list[Linked] = []
    for index, family in enumerate(kinds):
        if len(points) < family.catheter.electrodes:
            continue
        spacing_px = _spacing_px(family.catheter, shafts.px_per_mm)
        searched = sure if completed else len(points)
        paths = chain_search.paths(points[:searched], weights[:searched], spacing_px)
        if completed:
            paths = np.concatenate([paths, completed[index]])
        scores = chain_scores.scores(
            paths, points, weights, variance_px2, sure, _LOST, spacing_px, family.catheter.tip_mm, shafts.px_per_mm, shafts.smooth,
            shafts.reduction, shafts.clear, shafts.side_px, _SHAFT_WEIGHT, family.floor - slack,
        )  # fmt: skip
        best = np.argsort(-scores)[:_BEST]
        found += [
            Linked(tuple(paths[row].tolist()), index, float(scores[row])) for row in best if np.isfinite(scores[row])
        ]
    if not found:
        return ()
    found = sorted(found, key=lambda chain: -chain.score)[:_BEST]
    within = np.full((len(found), max(len(chain.candidates) for chain in found)), -1, np.int64)
    for row, chain in enumerate(found):
        within[row, : len(chain.candidates)] = chain.candidates
    chosen = chain_search.best_set(
        np.array([chain.score + _WORTH for chain in found]),
        chain_search.shared(within, points, _SAME_PLACE_MM * shafts.px_per_mm, _SAME_PLACES),
        np.array([chain.family for chain in found]),
        np.array([len(family.names) for family in kinds]),
        _SHARED,
    )
    return tuple(found[int(index)] for index in chosen)


def chain_score(points_uv: Array, weights: Array, variance_px2: Array, shafts: Shafts, family: Family) -> float:
    """Score of the chain that the points make in this order, as in :func:`link`."""
    return float(
        chain_scores.scores(
            np.arange(len(points_uv))[None, :], points_uv, weights, variance_px2, len(points_uv), _LOST,
            _spacing_px(family.catheter, shafts.px_per_mm), family.catheter.tip_mm, shafts.px_per_mm, shafts.smooth,
            shafts.reduction, shafts.clear, shafts.side_px, _SHAFT_WEIGHT, -np.inf,
        )[0]
    )  # fmt: skip


def spacing_fit(points_uv: Array, variance_px2: Array, catheter: Catheter, px_per_mm: float) -> Array:
    """Log-likelihood, up to a constant, of each chain's spacings (n, electrodes, 2) as those of this catheter, one
    foreshortening free; (n,)."""
    return chain_scores.spacing_fit(points_uv, _spacing_px(catheter, px_per_mm), variance_px2, px_per_mm)


def shaft_evidence(points_uv: Array, catheter: Catheter, shafts: Shafts) -> Array:
    """Of each chain (n, electrodes, 2), dark between the electrodes of the widest gap and behind the last electrode, not
    before the tip: -3 to 3, (n,)."""
    return chain_scores.shaft_evidence(
        points_uv, int(np.argmax(catheter.spacing_mm)), catheter.tip_mm, shafts.px_per_mm, shafts.smooth, shafts.reduction,
        shafts.clear, shafts.side_px,
    )  # fmt: skip


def _spacing_px(catheter: Catheter, px_per_mm: float) -> Array:
    return np.asarray(catheter.spacing_mm, dtype=np.float64) * px_per_mm


def kind_probabilities(log_likelihoods: Array, kinds: Sequence[Family]) -> tuple[tuple[tuple[str, float], ...], ...]:
    """Which catheter each chain of one frame is, given at most one chain a catheter.

    Parameters
    ----------
    log_likelihoods : (chains, families)
        How well each chain fits each family; -inf where it cannot be one of it.

    Returns
    -------
    One ``kinds`` a chain as in :class:`~fluoromap.contracts.Chain`: probabilities over all assignments that the catalogue
    allows; look-alikes share theirs equally.
    """
    chains, count = log_likelihoods.shape
    marginal = np.zeros((chains, count))
    relative = np.exp(log_likelihoods - log_likelihoods.max(axis=1, keepdims=True))

    def assign(chain: int, left: list[int], weight: float, taken: tuple[int, ...]) -> None:
        if weight <= 0:
            return
        if chain == chains:
            for index, family in enumerate(taken):
                marginal[index, family] += weight
            return
        for family in range(count):
            if left[family]:
                # Each of the look-alikes still free is one way to be of this family.
                left[family] -= 1
                assign(chain + 1, left, weight * relative[chain, family] * (left[family] + 1), (*taken, family))
                left[family] += 1

    assign(0, [len(family.names) for family in kinds], 1.0, ())
    marginal /= np.maximum(marginal.sum(axis=1, keepdims=True), math.ulp(0.0))
    return tuple(
        tuple(
            (name, float(row[index]) / len(family.names))
            for index, family in enumerate(kinds)
            for name in family.names
            if row[index] > 1e-6
        )
        for row in marginal
    )
