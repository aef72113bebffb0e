"""Linking: candidate electrodes become the best set of chains that fit the catalogue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.chains.families import CatheterFamily
from fluoromap.segmenter.chains.path_scores import score_paths, shafts_of_paths
from fluoromap.segmenter.chains.path_search import best_set, count_shared, find_paths
from fluoromap.segmenter.electrodes.proposals import log_odds
from fluoromap.segmenter.picture.shaft_image import ShaftImage
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES
from fluoromap.segmenter.shape.spacings import searched_spacing_px, spacing_px_of

_EVIDENCE_LEAST, _EVIDENCE_MOST = -1.0, 2.2
_SHAFT_WEIGHT = 0.4
_SHARED = 1.5
_LOST = 2.0
_BEST, _LEAST_OF_FAMILY = 80, 20
_SAME_PLACE_MM, _SAME_PLACES = 1.3, 3


@dataclass(frozen=True, slots=True)
class CandidateChain:
    """A chain of candidates.

    candidates : their indices from the tip on. family : index of the family. score : higher is better.
    """

    candidates: tuple[int, ...]
    family: int
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class PossibleChains:
    """All chains of candidates that the search found, and their scores.

    rows : for each family, the indices of the candidates from the tip on, (n, electrodes). scores : for each family, (n,); -inf
    where the chain is too unlikely.
    """

    rows: tuple[IntArray, ...]
    scores: tuple[Array, ...]

    def where(self, allowed: Sequence[BoolArray]) -> PossibleChains:
        """Return the chains for which ``allowed`` has True: one (n,) for each family."""
        return PossibleChains(
            tuple(rows[kept] for rows, kept in zip(self.rows, allowed, strict=True)),
            tuple(scores[kept] for scores, kept in zip(self.scores, allowed, strict=True)),
        )


@dataclass(frozen=True, slots=True)
class Trust:
    """The worth of one candidate's log-odds in a chain.

    share : 1 where candidates were judged one by one; less where the proposer saw the neighbours too, so that its errors go
    together. chain : added for each candidate, because candidates in a chain are electrodes more often than others.
    """

    share: float = 1.0
    chain: float = 0.0


ONE_BY_ONE = Trust()


def evidence(probability: Array, trust: Trust = ONE_BY_ONE) -> Array:
    """Return the weight of candidates with these probabilities in a chain's score.

    The weight is the log-odds: 0 for an even chance, between -1 and 2.2.
    """
    weight = trust.chain + trust.share * log_odds(probability)
    return np.minimum(np.maximum(weight, _EVIDENCE_LEAST), _EVIDENCE_MOST)


def link_candidates(
    points_uv: Array,
    weights: Array,
    variance_px2: Array,
    shaft_image: ShaftImage,
    families: Sequence[CatheterFamily],
    sure: int | None = None,
    slack: float = 0.0,
    completed: Sequence[IntArray] = (),
) -> tuple[CandidateChain, ...]:
    """Return the best set of chains, each ordered from the tip.

    See :func:`possible_chains` for the parameters and :func:`best_chains` for the set.
    """
    possible = possible_chains(points_uv, weights, variance_px2, shaft_image, families, sure, slack, completed)
    return best_chains(possible, points_uv, families, shaft_image.px_per_mm, sure)


def possible_chains(
    points_uv: Array,
    weights: Array,
    variance_px2: Array,
    shaft_image: ShaftImage,
    families: Sequence[CatheterFamily],
    sure: int | None = None,
    slack: float = 0.0,
    completed: Sequence[IntArray] = (),
) -> PossibleChains:
    """Return all chains that catheters can show.

    A chain's score is the sum of its candidates' weights. Penalties are subtracted for:

    - spacings whose foreshortening differs more than a bend in depth explains (0.06 SD),
    - bends (0.36 rad SD across the rays, more where foreshortened; S-bends count half more), of a circular catheter those that
      its loop does not explain,
    - strong foreshortening,
    - rings of unlike weight.

    A dark shaft between the electrodes and behind the last one raises the score; a dark shaft before the tip lowers it.

    Parameters
    ----------
    points_uv : (n, 2)
        Candidates, pixels.
    weights : (n,)
        Their :func:`evidence`.
    variance_px2 : (n,)
        Variance of each coordinate of a candidate.
    shaft_image : ShaftImage
    families : sequence of CatheterFamily
    sure : int
        Number of sure candidates; they come first. Other candidates may make up half of a chain at most, at a price. All
        candidates are sure by default.
    slack : float
        How far a chain's score may lie below its family's floor.
    completed : sequence of (n, electrodes) int
        More chains of each family, as indices from the tip on. Then the search itself uses only the sure candidates.
    """
    sure = len(points_uv) if sure is None else sure
    points = np.ascontiguousarray(points_uv, dtype=np.float64)
    all_rows, all_scores = [], []
    for index, family in enumerate(families):
        paths, scores = np.zeros((0, family.catheter.electrodes), np.int64), np.zeros(0)
        if len(points) >= family.catheter.electrodes:
            spacing_px = spacing_px_of(family.catheter, shaft_image.px_per_mm)
            searched = sure if completed else len(points)
            longest_px = searched_spacing_px(family.catheter, shaft_image.px_per_mm)
            paths = find_paths(
                points[:searched],
                weights[:searched],
                longest_px,
                shaft_image.px_per_mm,
                family.catheter.angles_on_loop_rad,
            )
            if completed:
                paths = np.concatenate([paths, completed[index]])
            scores = score_paths(
                paths, points, weights, variance_px2, sure, _LOST, spacing_px, family.catheter.tip_mm,
                family.catheter.curvature_per_mm, shaft_image.px_per_mm, shaft_image.smooth, shaft_image.reduction,
                shaft_image.clear, shaft_image.side_px, _SHAFT_WEIGHT, family.floor - slack,
            )  # fmt: skip
        all_rows.append(paths)
        all_scores.append(scores)
    return PossibleChains(tuple(all_rows), tuple(all_scores))


def best_chains(
    possible: PossibleChains,
    points_uv: Array,
    families: Sequence[CatheterFamily],
    px_per_mm: float,
    sure: int | None = None,
    is_merged: BoolArray | None = None,
) -> tuple[CandidateChain, ...]:
    """Return the best set of these chains, best first.

    The value of a set is the sum of its scores plus 1.5 for each electrode, 6 at least for each chain, so that a third,
    weaker catheter is not dropped, nor a part of a long one preferred. The first ``sure`` candidates were proposed,
    all by default; of the others only those count that a chain needs, see :func:`_needless`, and none that ``is_merged``.
    Crossing catheters may share one candidate at a price, but two chains must not exclude each other, see
    :func:`~fluoromap.segmenter.chains.path_search.count_shared`. A set has at most as many chains of a family as the catalogue has
    catheters.
    """
    points = np.ascontiguousarray(points_uv, dtype=np.float64)
    # A long catheter has many chains that differ in one electrode: they must not crowd out the other families.
    most = max(_LEAST_OF_FAMILY, _BEST // len(families))
    likely = possible.where([np.isfinite(scores) for scores in possible.scores])
    compared = [np.argsort(-scores, kind="stable")[:most] for scores in likely.scores]
    chosen = _best_set(likely, compared, points, families, px_per_mm, sure, is_merged)
    # Nor must parts of a long catheter crowd out another one of their own family, which lies elsewhere.
    for _ in range(len(families)):
        if len(chosen) in (0, sum(len(family.names) for family in families)):
            break
        compared = []
        for index, (paths, scores) in enumerate(zip(likely.rows, likely.scores, strict=True)):
            # A shorter chain may itself be a part of the other one.
            as_long = [chain for chain in chosen if len(chain.candidates) >= paths.shape[1]]
            taken = [candidate for chain in as_long for candidate in chain.candidates]
            away = np.linalg.norm(points[:, None] - points[taken], axis=2).min(axis=1, initial=np.inf)
            is_taken = away < _SAME_PLACE_MM * px_per_mm
            elsewhere = np.flatnonzero(is_taken[paths].sum(axis=1) < _SAME_PLACES)
            of_family = [chain.candidates for chain in chosen if chain.family == index]
            own = [np.flatnonzero((paths == np.array(candidates)).all(axis=1))[:1] for candidates in of_family]
            compared.append(np.concatenate([*own, elsewhere[np.argsort(-scores[elsewhere], kind="stable")[:most]]]))
        # The chosen chains are compared again, so that another set has a higher value.
        more = _best_set(likely, compared, points, families, px_per_mm, sure, is_merged)
        if set(more) == set(chosen):
            break
        chosen = more
    return chosen


def _best_set(
    possible: PossibleChains,
    compared: Sequence[IntArray],
    points: Array,
    families: Sequence[CatheterFamily],
    px_per_mm: float,
    sure: int | None,
    is_merged: BoolArray | None,
) -> tuple[CandidateChain, ...]:
    """Return the best set of some chains, best first.

    compared : for each family, the indices of these chains.
    """
    scores = np.concatenate([of_family[rows] for rows, of_family in zip(compared, possible.scores, strict=True)])
    if not len(scores):
        return ()
    family = np.repeat(np.arange(len(families)), [len(rows) for rows in compared])
    longest = max(paths.shape[1] for paths in possible.rows)
    within = np.full((len(scores), longest), -1, np.int64)
    for index, (rows, paths) in enumerate(zip(compared, possible.rows, strict=True)):
        within[family == index, : paths.shape[1]] = paths[rows]
    of_each = np.array([each.worth / each.catheter.electrodes for each in families])[family]
    electrodes = (within >= 0).sum(axis=1)
    if sure is not None and longest >= MANY_ELECTRODES:
        merged = np.zeros(len(points), np.bool_) if is_merged is None else is_merged
        electrodes -= _needless(within, family, sure, merged)
    values = scores + of_each * electrodes
    order = np.argsort(-values, kind="stable")
    within, family, scores = within[order], family[order], scores[order]
    chosen = best_set(
        values[order],
        count_shared(within, points, _SAME_PLACE_MM * px_per_mm, _SAME_PLACES),
        family,
        np.array([len(each.names) for each in families]),
        _SHARED,
    )
    return tuple(
        CandidateChain(
            tuple(within[row, : families[family[row]].catheter.electrodes].tolist()),
            int(family[row]),
            float(scores[row]),
        )
        for row in chosen.tolist()
    )


def _needless(chosen: IntArray, family: IntArray, sure: int, is_merged: BoolArray) -> IntArray:
    """Return how many electrodes of each chain nobody proposed and nobody needs, (n,).

    A short chain needs none of the electrodes that nobody proposed. A long chain needs some of them: else a chain that lies two
    electrodes too far along the catheter would win, and leave two to a part of another chain. It needs as many as that chain has
    which, among those of its family with half of its candidates, has the fewest. No chain needs an electrode that another one
    covers. Rows of ``chosen`` are filled up with -1.
    """
    merged = (is_merged[chosen] & (chosen >= 0)).sum(axis=1)
    needless: IntArray = (chosen >= sure).sum(axis=1) - merged
    for index in np.unique(family):
        own = np.flatnonzero(family == index)
        electrodes = np.count_nonzero(chosen[own[0]] >= 0)
        if electrodes >= MANY_ELECTRODES:
            member = np.zeros((len(own), chosen.max() + 1), np.float32)
            member[np.arange(len(own))[:, None], chosen[own, :electrodes]] = 1.0
            alike = member @ member.T >= electrodes / 2
            needless[own] -= np.where(alike, needless[own], electrodes).min(axis=1)
    needless += merged
    return needless


def chain_score(
    points_uv: Array, weights: Array, variance_px2: Array, shaft_image: ShaftImage, family: CatheterFamily
) -> float:
    """Return the score of the points in this order, as in :func:`possible_chains`."""
    return float(
        score_paths(
            np.arange(len(points_uv))[None, :], points_uv, weights, variance_px2, len(points_uv), _LOST,
            spacing_px_of(family.catheter, shaft_image.px_per_mm), family.catheter.tip_mm,
            family.catheter.curvature_per_mm, shaft_image.px_per_mm, shaft_image.smooth, shaft_image.reduction,
            shaft_image.clear, shaft_image.side_px, _SHAFT_WEIGHT, -np.inf,
        )[0]
    )  # fmt: skip


def shaft_evidence(points_uv: Array, catheter: Catheter, shaft_image: ShaftImage) -> Array:
    """Return how clearly each chain (n, electrodes, 2) shows a shaft.

    The result (n,) lies between -3 and 3. Dark pixels in the widest gap and behind the last electrode count for a
    shaft, dark pixels before the tip against it.
    """
    return shafts_of_paths(
        points_uv, int(np.argmax(catheter.spacing_mm)), catheter.tip_mm, shaft_image.px_per_mm, shaft_image.smooth,
        shaft_image.reduction, shaft_image.clear, shaft_image.side_px,
    )  # fmt: skip
