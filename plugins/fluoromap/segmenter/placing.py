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
_NEAR_MM, _NEAR_FACTOR = 3.0, 2.5


@dataclass(frozen=True, slots=True)
class Placed:
    """A chain, its scores being what linking gave it, and how clearly its electrodes look like electrodes
    (:attr:`~fluoromap.segmenter.refinement.Refined.clearness`)."""

    chain: Chain
    clearness: float


def place_chains(
    x: Image,
    candidates_uv: Array,
    linked: Sequence[Linked],
    shafts: Shafts,
    kinds: tuple[Family, ...],
    noise: float,
    sound: int | None = None,
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
    noise : float
        Of a pixel, log units, see :func:`~fluoromap.segmenter.log_image.pixel_noise`.
    sound : int
        Candidates from this one on were not seen by themselves. All are by default.

    Returns
    -------
    tuple of Placed
        In the order of ``linked``.
    """
    likelihood = np.full((len(linked), len(kinds)), -np.inf)
    lost = _lost_to_others(candidates_uv, linked, kinds)
    places: dict[tuple[int, int], tuple[Refined, int]] = {}
    for column, family in enumerate(kinds):
        rows = [row for row, chain in enumerate(linked) if len(chain.candidates) == family.catheter.electrodes]
        if not rows:
            continue
        order = np.array([linked[row].candidates for row in rows])
        hidden = np.array([[candidate in lost[row] for candidate in linked[row].candidates] for row in rows])
        order, hidden = (np.concatenate([forth, forth[:, ::-1]]) for forth in (order, hidden))
        unseen = np.zeros_like(hidden) if sound is None else order >= sound
        refined = refine(x, candidates_uv[order], family.catheter, shafts.px_per_mm, noise, hidden, unseen)
        settled = np.zeros(order.shape)
        fit = refined.log_likelihood + spacing_fit(refined.points_uv, settled, family.catheter, shafts.px_per_mm)
        fit += _SHAFT_WEIGHT * shaft_evidence(refined.points_uv, family.catheter, shafts)
        for index, row in enumerate(rows):
            best = index if fit[index] >= fit[index + len(rows)] else index + len(rows)
            likelihood[row, column] = fit[best]
            places[row, column] = refined, best
    probabilities = kind_probabilities(likelihood, kinds)
    chains = []
    for row, chain in enumerate(linked):
        of_family = [
            sum(probability for name, probability in probabilities[row] if name in family.names) for family in kinds
        ]
        refined, best = places.get((row, int(np.argmax(of_family)))) or places[row, chain.family]
        chains.append(
            Placed(
                Chain(
                    electrodes=tuple(range(1, len(chain.candidates) + 1)),
                    pixels_uv=refined.points_uv[best],
                    covariance_px2=refined.covariance_px2[best],
                    scores=np.full(len(chain.candidates), chain.score),
                    kinds=probabilities[row],
                ),
                float(refined.clearness[best]),
            )
        )
    return tuple(chains)


def widened_covariance(chain: Chain, others: Sequence[Chain], px_per_mm: float) -> Array:
    """The chain's covariances, larger where electrodes of other chains stand so near that their bands disturb each other."""
    if not others:
        return chain.covariance_px2
    beside = np.concatenate([other.pixels_uv for other in others])
    near = np.linalg.norm(chain.pixels_uv[:, None] - beside[None], axis=2).min(axis=1) < _NEAR_MM * px_per_mm
    return np.where(near[:, None, None], _NEAR_FACTOR, 1.0) * chain.covariance_px2


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
