"""Candidate electrodes -> chains that fit a catheter of the catalogue; the best set of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array
from fluoromap.segmenter.contrast import Contrast

SHORTEST, LONGEST = 0.45, 1.12
"""A spacing seen over the same spacing lying across the rays at the isocentre: foreshortened, or nearer to the source."""

_SPACING_SD = 0.10
_BEND_SD = 0.40
_LEAST_COSINE = 0.55
_TIP_SLACK = 0.8, 1.1
_SPREAD = 0.45
_EVIDENCE_FROM, _EVIDENCE_MOST = 4.0, 2.2
_SHAFT_WEIGHT = 0.4
_SHARED = 1.5
_LOST = 2.0
_WORTH = 6.0
_BEST = 80
_PARTIAL = 600


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


def evidence(contrast_over_noise: Array) -> Array:
    """What a candidate adds to a chain's score: 0 at 4 sigma, growing with the logarithm, at most 2.2."""
    rising: Array = np.log(np.maximum(contrast_over_noise, 1e-3) / _EVIDENCE_FROM)
    return np.clip(rising, -1.0, _EVIDENCE_MOST)


def link(points_uv: Array, contrast: Contrast, kinds: Sequence[Family], sure: int) -> tuple[Linked, ...]:
    """The best set of chains: ordered from the tip, at most as many of a family as the catalogue has.

    A chain's score is the sum of its candidates' :func:`evidence`, less penalties for spacings that are not foreshortened
    alike (0.10 SD), for bends (0.40 rad SD; S-bends count half more), for strong foreshortening and for rings of
    unlike contrast, plus evidence of a dark shaft between the electrodes and behind the last but not before the tip.
    Crossing catheters may share one candidate, at a price.

    Parameters
    ----------
    points_uv : (n, 2)
        Candidates, pixels.
    contrast : Contrast
    kinds : sequence of Family
    sure : int
        The first so many candidates passed the threshold; the others may make up half of a chain at most.

    Returns
    -------
    tuple of Linked
        None below its family's floor.
    """
    found: list[Linked] = []
    weights = evidence(contrast.of(points_uv)) if len(points_uv) else np.zeros(0)
    for index, family in enumerate(kinds):
        for candidates in _paths(points_uv, weights, family.catheter, contrast.px_per_mm):
            if 2 * sum(candidate < sure for candidate in candidates) < len(candidates):
                continue
            chosen = list(candidates)
            price = _LOST * sum(candidate >= sure for candidate in candidates)
            score = _score(points_uv[chosen], weights[chosen], family.catheter, contrast, family.floor + price) - price
            if score >= family.floor:
                found.append(Linked(candidates, index, score))
    found.sort(key=lambda chain: -chain.score)
    return _best_set(found[:_BEST], [len(family.names) for family in kinds])


def spacing_fit(points_uv: Array, catheter: Catheter, px_per_mm: float) -> float:
    """Log-likelihood, up to a constant, of the points' spacings as those of this catheter, one foreshortening free."""
    seen = np.linalg.norm(np.diff(points_uv, axis=0), axis=1) / (np.asarray(catheter.spacing_mm) * px_per_mm)
    return float(-0.5 * np.sum(((seen - seen.mean()) / _SPACING_SD) ** 2))


def _paths(points: Array, weights: Array, catheter: Catheter, px_per_mm: float) -> list[tuple[int, ...]]:
    """All orders of candidates whose spacings and bends this catheter could show; the best few hundred at each length."""
    n = len(points)
    if n < catheter.electrodes:
        return []
    steps = points[None, :, :] - points[:, None, :]
    lengths = np.hypot(steps[..., 0], steps[..., 1])
    partial: list[tuple[float, tuple[int, ...], tuple[float, ...]]] = [(float(weights[i]), (i,), ()) for i in range(n)]
    for spacing in catheter.spacing_mm:
        seen = lengths / (spacing * px_per_mm)
        reachable = (seen >= SHORTEST * _TIP_SLACK[0]) & (seen <= LONGEST * _TIP_SLACK[1])
        longer = []
        for value, path, ratios in partial:
            last = path[-1]
            for following in np.flatnonzero(reachable[last]).tolist():
                ratio = float(seen[last, following])
                if following in path or any(abs(ratio - other) > _SPREAD for other in ratios):
                    continue
                if len(path) > 1:
                    before, after = steps[path[-2], last], steps[last, following]
                    cosine = float(before @ after) / float(lengths[path[-2], last] * lengths[last, following])
                    if cosine < _LEAST_COSINE:
                        continue
                longer.append((value + float(weights[following]), (*path, following), (*ratios, ratio)))
        longer.sort(key=lambda item: -item[0])
        partial = longer[:_PARTIAL]
    return [path for _, path, ratios in partial if SHORTEST <= sum(ratios) / len(ratios) <= LONGEST]


def _score(points: Array, weights: Array, catheter: Catheter, contrast: Contrast, least: float) -> float:
    """Score of one chain; -inf, without a look at the shaft, where that cannot lift it to ``least``."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    along = steps / lengths[:, None]
    foreshortening = float(lengths.sum() / (sum(catheter.spacing_mm) * contrast.px_per_mm))
    score = float(weights.sum()) + spacing_fit(points, catheter, contrast.px_per_mm)
    score -= 2.0 * max(0.0, 0.75 - foreshortening)
    turns = np.arctan2(
        along[:-1, 0] * along[1:, 1] - along[:-1, 1] * along[1:, 0], np.einsum("ij,ij->i", along[:-1], along[1:])
    )
    if len(turns) > 1 and turns.min() < -0.12 and turns.max() > 0.12:
        turns = 1.5 * turns
    score -= 0.5 * float(np.sum((turns / _BEND_SD) ** 2))
    if len(weights) > 2:
        score -= 0.6 * float(np.ptp(weights[1:]))
    if score + 3.0 * _SHAFT_WEIGHT < least:
        return -math.inf
    return score + _SHAFT_WEIGHT * shaft_evidence(points, catheter, contrast)


def shaft_evidence(points: Array, catheter: Catheter, contrast: Contrast) -> float:
    """Dark between the electrodes of the widest gap and behind the last electrode, not before the tip: -3 to 3."""
    along = np.diff(points, axis=0)
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    widest = int(np.argmax(catheter.spacing_mm))
    step = points[widest + 1] - points[widest]
    between = contrast.shaft(points[widest] + 0.25 * step, points[widest + 1] - 0.25 * step)
    one_mm = contrast.px_per_mm
    behind = contrast.shaft(points[-1] + 2.4 * one_mm * along[-1], points[-1] + 5.9 * one_mm * along[-1])
    clear = 0.5 * catheter.tip_mm + 2.1
    before = contrast.shaft(points[0] - clear * one_mm * along[0], points[0] - (clear + 3.5) * one_mm * along[0])
    return between + behind - before


def _best_set(chains: Sequence[Linked], capacity: list[int]) -> tuple[Linked, ...]:
    """Branch and bound over chains sorted by score: each chain is worth its score plus 6, so that a third, weaker catheter
    is not dropped; two chains may share one candidate at a price of 1.5."""
    best_value, best = 0.0, ()  # type: tuple[float, tuple[Linked, ...]]
    most = sum(capacity)

    def extend(start: int, chosen: tuple[Linked, ...], value: float) -> None:
        nonlocal best_value, best
        if value > best_value:
            best_value, best = value, chosen
        room = most - len(chosen)
        if not room:
            return
        for index in range(start, len(chains)):
            chain = chains[index]
            if value + room * (chain.score + _WORTH) <= best_value:
                return
            if sum(other.family == chain.family for other in chosen) >= capacity[chain.family]:
                continue
            shared = [len(set(chain.candidates) & set(other.candidates)) for other in chosen]
            if sum(shared) > 1:
                continue
            extend(index + 1, (*chosen, chain), value + chain.score + _WORTH - _SHARED * sum(shared))

    extend(0, (), 0.0)
    return best


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
