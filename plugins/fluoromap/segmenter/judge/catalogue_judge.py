"""Judge of the chains of one picture: whether they can be catheters of the catalogue, beside what else the picture shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, BoolArray, Chain
from fluoromap.segmenter.chains.families import family_of
from fluoromap.segmenter.electrodes.proposals import (
    ImageEvidence,
    Proposals,
    answers_for_each,
    log_odds,
    shaft_image_of,
)
from fluoromap.segmenter.judge.acceptance import UNSEEN, Acceptance
from fluoromap.segmenter.judge.features.bars import follows_bars, products_beside
from fluoromap.segmenter.judge.features.crossings import are_crossings
from fluoromap.segmenter.judge.features.dark_lines import depths_along, is_dark_line
from fluoromap.segmenter.judge.features.shared_metal import lies_on_metal
from fluoromap.segmenter.judge.features.unexplained_rows import (
    EVEN_ODDS,
    SURE,
    continues,
    not_on,
    unexplained_between,
)
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

_WEAKER = 0.25
"""Quantile of the log-odds of a long chain that its weaker electrodes have."""
_FOR_ONE_CROSSING = 8
"""Electrodes of a chain for which one thing may cross it."""
_CLEARLY_LESS, _MOST_EXCUSED = 0.5, 1.0
"""How much less probable than electrodes parts of a shaft are, and what is no part of a shaft in any case, log-odds."""
NO_ELECTRODE = -1.0
"""Log-odds below which a place is clearly no electrode."""
_PAIR = 2
"""Electrodes in a chain's line, like its own, that are a pair of a longer catheter."""


@dataclass(frozen=True, slots=True, eq=False)
class CatalogueJudge:
    """Judge of chains that were found in one picture, by a study's catalogue."""

    catalogue: Catalogue
    acceptance: Acceptance
    px_per_mm: float

    def are_of_catalogue(self, chains: tuple[Chain, ...], seen: ImageEvidence, proposed: Proposals) -> BoolArray:
        """Return which chains can be catheters of the catalogue, (n,).

        Others are part of a catheter with more electrodes than the catalogue has, or no catheter: their electrodes are places on
        parallel bars. The electrodes of one catheter look alike, so proposals in less than half of the gaps may be parts of a
        dark shaft if they are less probable: less than a long chain's weaker electrodes, or clearly less than all electrodes of
        a short one and 0.73 at most. Electrodes of a long chain in another chain's line belong to the long one, if that is
        listed. Two in the line that are nearly as probable as the chain's middle electrode are a pair of a longer catheter.
        Besides, one thing may cross each eight electrodes of a chain, unless it has places without an electrode, as displaced
        chains have.
        """
        free = not_on(proposed.points_uv, chains, self.px_per_mm)
        places = [free, proposed.points_uv, *(chain.pixels_uv for chain in chains)]
        odds_of_free, odds, *odds_of_chains = answers_for_each(seen.kind_odds_at, places)
        listed = np.ones(len(chains), np.bool_)
        # What is no catheter of the catalogue explains nothing in the line of a shorter chain.
        for index in sorted(range(len(chains)), key=lambda one: -len(chains[one].electrodes)):
            chain, own = chains[index], odds_of_chains[index]
            family = family_of(chain, self.catalogue)
            is_seen = chain.scores > UNSEEN
            if (
                family is None
                or self._lies_on_another(index, chains, listed)
                or self._lies_on_a_line(chain.pixels_uv[is_seen], seen, family.catheter)
            ):
                listed[index] = False
                continue
            onwards = EVEN_ODDS
            own = own[is_seen]
            if len(chain.electrodes) >= MANY_ELECTRODES:
                like = max(EVEN_ODDS, float(np.quantile(own, _WEAKER, method="lower")))
                onwards = min(like, _MOST_EXCUSED)
            else:
                like = min(max(EVEN_ODDS, float(own.min()) - _CLEARLY_LESS), _MOST_EXCUSED)
            long_ones = [
                other
                for other, kept in zip(chains, listed, strict=True)
                if kept and other is not chain and len(other.electrodes) >= MANY_ELECTRODES
            ]
            row = not_on(proposed.points_uv[odds >= onwards], long_ones, self.px_per_mm)
            sure, alike = free[odds_of_free >= EVEN_ODDS], free[odds_of_free >= like]
            pair = free[odds_of_free >= max(float(np.median(own)) - _CLEARLY_LESS, _MOST_EXCUSED)]
            unexplained = sure, alike, row, pair
            crossings = len(own) // _FOR_ONE_CROSSING if own.min() >= NO_ELECTRODE else 0
            listed[index] = self._explains(chain, family.catheter, crossings, *unexplained)
            if not listed[index]:
                uncrossed = (self._not_crossed(points, chain, seen) for points in unexplained)
                listed[index] = self._explains(chain, family.catheter, crossings, *uncrossed)
        return listed

    def hides_a_pair(self, chain: Chain, scores: Array, proposed: Proposals) -> bool:
        """Return whether something hides a pair of a long catheter.

        A chain that is displaced along its catheter leaves a pair beyond its other end.
        """
        if len(scores) < MANY_ELECTRODES or not self.acceptance.hidden_pair.allow(scores):
            return False
        family = family_of(chain, self.catalogue)
        sure = proposed.points_uv[proposed.probability >= SURE]
        return family is not None and not continues(chain, sure, family.catheter, self.px_per_mm, least=1)

    def _lies_on_a_line(self, chain_uv: Array, seen: ImageEvidence, catheter: Catheter) -> bool:
        """Return whether a chain (n, 2) lies on parallel bars or on a dark line.

        A loop on edge shows both sides as one line. Scores that are no probabilities, but contrasts, count as sure.
        """
        shafts = shaft_image_of(seen, self.px_per_mm)
        on_dark_line = not catheter.is_circular and is_dark_line(
            [depths_along(chain_uv, shafts)], log_odds(seen.scores_at(chain_uv)), self.acceptance.dark_lines
        )
        return on_dark_line or follows_bars(products_beside(chain_uv, shafts))

    def _lies_on_another(self, index: int, chains: Sequence[Chain], listed: BoolArray) -> bool:
        """Return whether a chain lies on the metal of another one that is listed."""
        family = family_of(chains[index], self.catalogue)
        others = [
            (other, family_of(other, self.catalogue))
            for other, kept in zip(chains, listed, strict=True)
            if kept and other is not chains[index]
        ]
        return family is not None and any(
            of_other is not None
            and lies_on_metal(chains[index], family.catheter, other, of_other.catheter, self.px_per_mm)
            for other, of_other in others
        )

    def _explains(
        self, chain: Chain, catheter: Catheter, crossings: int, sure: Array, alike: Array, row: Array, pair: Array
    ) -> bool:
        """Return whether a chain leaves no electrodes of its catheter unexplained.

        crossings : how many things may cross the chain. sure, alike : proposals that no chain explains, (n, 2). row : proposals in
        whose line the chain may be. pair : those that no chain explains and that are like its electrodes, so that two are enough.
        """
        # Those alike are among the sure ones.
        between = unexplained_between(chain, sure, catheter, self.px_per_mm)
        return (
            2 * between < len(chain.electrodes)
            and not (between > crossings and unexplained_between(chain, alike, catheter, self.px_per_mm))
            and not continues(chain, row, catheter, self.px_per_mm)
            and not continues(chain, pair, catheter, self.px_per_mm, _PAIR)
        )

    def _not_crossed(self, points_uv: Array, chain: Chain, seen: ImageEvidence) -> Array:
        """Return the points at which nothing crosses the chain."""
        return points_uv[~are_crossings(points_uv, chain.pixels_uv, shaft_image_of(seen, self.px_per_mm))]
