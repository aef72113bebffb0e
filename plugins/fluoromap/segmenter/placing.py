"""Linked candidates -> chains: electrodes placed, order and kind settled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.linking import Family, Linked, Shafts, kind_probabilities, shaft_evidence, spacing_fit
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.refinement import Refined, on_curve, refine

_SHAFT_WEIGHT = 1.0


@dataclass(frozen=True, slots=True)
class Placed:
    """A chain, its scores being what linking gave it, and how clearly its electrodes look like electrodes
    (:attr:`~fluoromap.segmenter.refinement.Refined.clearness`)."""

    chain: Chain
    clearness: float


def place_chains(
    x: Image, candidates_uv: Array, linked: Sequence[Linked], shafts: Shafts, kinds: tuple[Family, ...]
) -> tuple[Placed, ...]:
    """Place, order and kind of each chain: whichever catheter of as many electrodes, tip first or last, fits best.

    Parameters
    ----------
    x : (rows, columns) float32
        Log image.
    candidates_uv : (n, 2)
        What the chains were linked from.
    linked : sequence of Linked
    shafts : Shafts
    kinds : tuple of Family

    Returns
    -------
    tuple of Placed
        In the order of ``linked``.
    """
    likelihood = np.full((len(linked), len(kinds)), -np.inf)
    lost = _lost_to_others(candidates_uv, linked, kinds)
    places: list[list[Refined | None]] = [[None] * len(kinds) for _ in linked]
    for row, chain in enumerate(linked):
        for order in (chain.candidates, chain.candidates[::-1]):
            hidden = [place for place, candidate in enumerate(order) if candidate in lost[row]]
            points = candidates_uv[list(order)]
            settled = np.zeros(len(points))
            for column, family in enumerate(kinds):
                if family.catheter.electrodes != len(points):
                    continue
                place = refine(x, points, family.catheter, shafts.px_per_mm, hidden)
                fit = place.log_likelihood + spacing_fit(place.points_uv, settled, family.catheter, shafts.px_per_mm)
                fit += _SHAFT_WEIGHT * shaft_evidence(place.points_uv, family.catheter, shafts)
                if fit > likelihood[row, column]:
                    likelihood[row, column] = fit
                    places[row][column] = place
    probabilities = kind_probabilities(likelihood, kinds)
    chains = []
    for row, chain in enumerate(linked):
        of_family = [
            sum(probability for name, probability in probabilities[row] if name in family.names) for family in kinds
        ]
        best = places[row][int(np.argmax(of_family))] or places[row][chain.family]
        assert best is not None
        chains.append(
            Placed(
                Chain(
                    electrodes=tuple(range(1, len(chain.candidates) + 1)),
                    pixels_uv=best.points_uv,
                    covariance_px2=best.covariance_px2,
                    scores=np.full(len(chain.candidates), chain.score),
                    kinds=probabilities[row],
                ),
                best.clearness,
            )
        )
    return tuple(chains)


def _lost_to_others(
    candidates_uv: Array, linked: Sequence[Linked], kinds: Sequence[Family]
) -> tuple[frozenset[int], ...]:
    """Of each chain, the candidates that it shares with another chain on whose curve they lie better: where two catheters
    cross, one blob stands for two electrodes and has the place of one."""
    lost: list[set[int]] = [set() for _ in linked]
    for row, chain in enumerate(linked):
        for other in range(row):
            for candidate in set(chain.candidates) & set(linked[other].candidates):
                away = [_off_curve(candidates_uv, linked[one], kinds, candidate) for one in (row, other)]
                lost[row if away[0] > away[1] else other].add(candidate)
    return tuple(frozenset(candidates) for candidates in lost)


def _off_curve(candidates_uv: Array, chain: Linked, kinds: Sequence[Family], candidate: int) -> float:
    points = candidates_uv[list(chain.candidates)]
    covered = np.array([one == candidate for one in chain.candidates])
    if np.count_nonzero(~covered) < 2:
        return 0.0
    predicted = on_curve(points, covered, kinds[chain.family].catheter.arc_lengths_mm)
    return float(np.linalg.norm(predicted - points[covered]))
