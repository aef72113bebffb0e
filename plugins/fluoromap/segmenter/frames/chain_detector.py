"""Chains of one image: proposals, linking, fit; and chains of other frames."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, BoolArray, Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.chains.families import CatheterFamily, catheter_families, family_of
from fluoromap.segmenter.chains.linking import (
    CandidateChain,
    PossibleChains,
    best_chains,
    chain_score,
    evidence,
    link_candidates,
    possible_chains,
)
from fluoromap.segmenter.chains.missing_electrodes import complete_chains
from fluoromap.segmenter.chains.rigid_search import rigid_search
from fluoromap.segmenter.electrodes.proposals import (
    ImageEvidence,
    Proposals,
    Proposer,
    answers_for_each,
    log_odds,
    shaft_image_of,
)
from fluoromap.segmenter.judge.acceptance import UNSEEN, Acceptance, shows_enough
from fluoromap.segmenter.judge.catalogue_judge import NO_ELECTRODE, CatalogueJudge
from fluoromap.segmenter.judge.features.faded_ends import without_shorter_catheters
from fluoromap.segmenter.judge.features.unexplained_rows import (
    EVEN_ODDS,
    SURE,
    not_on,
    shows_row,
)
from fluoromap.segmenter.picture.field_mask import FieldMask, are_in
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.picture.moved_means import moved_means
from fluoromap.segmenter.places import ellipse
from fluoromap.segmenter.places.chain_fitting import HIDING_MM, FittedChain, are_hidden, fit_chains
from fluoromap.segmenter.places.refinement import refine
from fluoromap.segmenter.shape.chain_comparison import is_same_shape
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

_COMPANION_SLACK = 2.5
_AGAIN_SLACK = 2.5
_CONFIRMED_CONTRAST = 3.0
_LEAST_FREE = 2
_WORST_FIT = 2.0
_BESIDE_MM = 2.0
_LEAST_MOVING_ODDS, _LEAST_ROW_ODDS, _FAINT_CONTRAST = 0.2, -0.2, 11.0
"""Least log-odds of the middle electrode in a moved mean: of any chain, and of a long row of less contrast over noise."""
_GOOD_ALONE = 1.5
_EXCHANGED = 2
_LEAST_PLACES, _TWICE = 4, 3.0
_SAME_PLACE_MM = 1.0
_SURE_AT_EDGE = 2


@dataclass(frozen=True, slots=True, eq=False)
class _Linking:
    """Chains of one image's candidates.

    points_uv : the candidates, (n, 2) pixels; the first ``proposed`` of them were proposed. chains : the best set of the possible.
    """

    points_uv: Array
    proposed: int
    possible: PossibleChains
    chains: tuple[CandidateChain, ...]
    is_merged: BoolArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Clear:
    """A chain that is clear enough in the image.

    judged : the fitted chain with its electrodes where the proposer is surest of them.
    """

    candidates: CandidateChain
    fitted: FittedChain
    judged: Chain


@dataclass(frozen=True, slots=True, eq=False)
class _FittedSet:
    """Accepted chains of one image.

    candidates : of each chain. unlisted : chains that are part of a catheter with more electrodes. sure : whether one fitted
    chain is clear enough.
    """

    chains: tuple[Chain, ...]
    candidates: tuple[CandidateChain, ...]
    unlisted: tuple[CandidateChain, ...]
    sure: bool

    @property
    def explained(self) -> int:
        """Number of the chains' electrodes."""
        return sum(len(chain.electrodes) for chain in self.chains)


@dataclass(frozen=True, slots=True, eq=False)
class SearchedImage:
    """A log image, what the proposer says about it, and the chains that were found in it.

    proposed : the candidates of the search.
    """

    x: Image
    seen: ImageEvidence
    proposed: Proposals
    found: _FittedSet

    def entry(self, frame: int) -> FrameChains:
        """Return the chains, or the reason why there are none."""
        sure = self.found.sure and self.found.chains
        return FrameChains(frame, self.found.chains, None if sure else Reason.MANUAL_NEEDED)


@dataclass(slots=True, eq=False)
class ChainDetector:
    """Detector of chains among the proposals of one proposer, for one run.

    It stores what the proposer said about the latest image.
    """

    catalogue: Catalogue
    field: FieldMask
    px_per_mm: float
    proposer: Proposer
    acceptance: Acceptance
    _latest: tuple[Image, ImageEvidence] | None = dataclasses.field(default=None, init=False, repr=False)

    def image_evidence(self, x: Image) -> ImageEvidence:
        """Return what the proposer says about a log image."""
        if self._latest is None or self._latest[0] is not x:
            self._latest = x, self.proposer(x)
        return self._latest[1]

    def forget_image(self) -> None:
        """Ask the proposer again when the latest image comes back."""
        self._latest = None

    @property
    def _judge(self) -> CatalogueJudge:
        return CatalogueJudge(self.catalogue, self.acceptance, self.px_per_mm)

    def _evidence(self, probability: Array) -> Array:
        return evidence(probability, self.acceptance.trust)

    def find_chains(self, x: Image, frame: int, beside: Sequence[Image] = ()) -> FrameChains:
        """Return the chains of one log image, or the reason why there are none."""
        return self.search(x).entry(frame)

    def search(self, x: Image) -> SearchedImage:
        """Search the chains of one log image.

        One chain must exceed its family's floor and clearly look like electrodes. Then weaker chains beside it are
        accepted too. Weaker chains alone come with ``manual_needed``. Where catheters lack, electrodes near the edge of the field
        may belong to them. In an image where two of these are sure, all compete at once.
        """
        seen = self.image_evidence(x)
        proposed = seen.proposals(self.field.with_edge, max(2, self._electrodes // 2))
        at_edge = ~are_in(self.field.candidates, proposed.points_uv)
        sure_at_edge = np.count_nonzero(proposed.probability[at_edge] >= SURE)
        if not at_edge.any() or (self.acceptance.strict and sure_at_edge >= _SURE_AT_EDGE):
            return SearchedImage(x, seen, proposed, self._chains_of(x, seen, proposed))
        away = proposed.where(~at_edge)
        searched = SearchedImage(x, seen, away, self._chains_of(x, seen, away))
        if len(searched.found.chains) == len(self.catalogue.catheters):
            return searched
        other = SearchedImage(x, seen, proposed, self._chains_of(x, seen, proposed))
        return other if other.found.explained > searched.found.explained else searched

    def split_pairs(self, searched: SearchedImage) -> SearchedImage:
        """Search an image again with pairs split into two electrodes.

        Such pairs were proposed as one electrode. The result is the image as it was searched before, where the split explains no
        more electrodes, and as many no better although a long chain had places that are clearly none.
        """
        sure = [chain for chain in searched.found.chains if not _is_doubtful(chain, searched.seen)]
        doubtful = len(sure) < len(searched.found.chains)
        # Split pairs must not make a part of an unlisted catheter a listed one, unless that is longer than the part.
        missing = Counter(catheter.electrodes for catheter in self.catalogue.catheters)
        missing -= Counter(len(chain.electrodes) for chain in searched.found.chains)
        is_unlisted = any(len(one.candidates) >= max(missing, default=0) for one in searched.found.unlisted)
        if (searched.found.explained >= self._electrodes and not doubtful) or is_unlisted:
            return searched
        halves = searched.seen.halves_of_pairs(self.field.candidates)
        if not len(halves):
            return searched
        proposed = searched.proposed.with_more(halves)
        found = self._chains_of(searched.x, searched.seen, proposed, len(halves))
        split = replace(searched, found=self._with_known_places(found, sure))
        explains_more = split.found.explained > searched.found.explained
        if not explains_more and doubtful and split.found.explained == searched.found.explained:
            explains_more = self._evidence_for(split) > self._evidence_for(searched)
        return split if explains_more else searched

    def has_doubtful_places(self, searched: SearchedImage) -> bool:
        """Return whether a long chain has places that are clearly no electrodes.

        It may lie a pair of electrodes too far along its catheter, where a foreshortened pair was proposed as one electrode.
        """
        return any(_is_doubtful(chain, searched.seen) for chain in searched.found.chains)

    def _evidence_for(self, searched: SearchedImage) -> float:
        """Return how much speaks for the electrodes of all chains."""
        return sum(
            float(self._evidence(searched.seen.probability_at(chain.pixels_uv)).sum())
            for chain in searched.found.chains
        )

    def _with_known_places(self, found: _FittedSet, known: Sequence[Chain]) -> _FittedSet:
        """Return the chains, but known ones at their places.

        A known chain has as many electrodes, and half of the chain's electrodes lie on its own. The places of split pairs are
        less exact.
        """
        reach = _SAME_PLACE_MM * self.px_per_mm
        chains = []
        for chain in found.chains:
            alike = [
                other
                for other in known
                if other.electrodes == chain.electrodes
                and 2 * np.count_nonzero(_away(chain.pixels_uv, other.pixels_uv) < reach) >= len(chain.electrodes)
            ]
            chains.append(alike[0] if alike else chain)
        return replace(found, chains=tuple(chains))

    @property
    def _electrodes(self) -> int:
        return sum(catheter.electrodes for catheter in self.catalogue.catheters)

    def _chains_of(self, x: Image, seen: ImageEvidence, proposed: Proposals, halves: int = 0) -> _FittedSet:
        """Return the accepted chains of these proposals.

        The last ``halves`` of them are electrodes of split pairs.
        """
        families = catheter_families(self.catalogue)
        linking = self._link(seen, proposed, families, halves)
        result = self._fit(x, seen, proposed, linking, families)
        if self.acceptance.strict and len(result.candidates) < len(linking.chains):
            again = self._link_without_rejected(seen, linking, result, families)
            if not set(again.chains) <= set(result.candidates):
                other = self._fit(x, seen, proposed, again, families)
                result = other if other.explained > result.explained else result
        return result

    def _link(
        self, seen: ImageEvidence, proposed: Proposals, families: tuple[CatheterFamily, ...], halves: int
    ) -> _Linking:
        """Link the proposals, and complete chains where not every catheter has a well-fitting one."""
        shaft_image = shaft_image_of(seen, self.px_per_mm)
        # A copy that may be written to, as the completed points: kernels are compiled for one kind of array only.
        points = proposed.points_uv.copy()
        weights, variance = self._evidence(proposed.probability), proposed.variance_px2
        possible = possible_chains(points, weights, variance, shaft_image, families, slack=_COMPANION_SLACK)
        possible = self._without_shorter_catheters(possible, points, seen, families)
        possible = with_whole_places(possible, points, families, len(points) - halves, halves)
        linked = best_chains(possible, points, families, self.px_per_mm)
        if self._is_complete(linked, weights):
            return _Linking(points, len(points), possible, self._with_clearer_electrodes(linked, possible, weights))

        def dark(places: Array) -> Array:
            probability = seen.unseen_probability_at(places)
            known = np.where(probability > 0, self._evidence(probability), -np.inf)
            # Outside the field nothing speaks for or against an electrode.
            return np.where(self._is_seen(places), known, 0.0)

        completed = complete_chains(
            points,
            weights,
            variance,
            dark,
            self.acceptance.unseen_evidence,
            families,
            self.px_per_mm,
            self.field.inside,
        )
        possible = possible_chains(
            completed.points_uv,
            completed.weights,
            completed.variance_px2,
            shaft_image,
            families,
            len(points),
            _COMPANION_SLACK,
            completed.rows,
        )
        possible = self._without_shorter_catheters(possible, completed.points_uv, seen, families)
        possible = with_whole_places(possible, completed.points_uv, families, len(points) - halves, halves)
        linked = best_chains(possible, completed.points_uv, families, self.px_per_mm, len(points), completed.is_merged)
        clearer = self._with_clearer_electrodes(linked, possible, completed.weights)
        return _Linking(completed.points_uv, len(points), possible, clearer, completed.is_merged)

    def _with_clearer_electrodes(
        self, linked: tuple[CandidateChain, ...], possible: PossibleChains, weights: Array
    ) -> tuple[CandidateChain, ...]:
        """Return the chains, long ones with other electrodes where these are clearer.

        The errors of one proposer go together, so its log-odds count in part only for a whole chain. Of two chains that have all
        electrodes but two in common, these two decide, and what the proposer says of them counts in full.
        """
        more = 1.0 / self.acceptance.trust.share - 1.0
        chosen = list(linked)
        for index, chain in enumerate(linked):
            if len(chain.candidates) < MANY_ELECTRODES or more == 0.0:
                continue
            rows, scores = possible.rows[chain.family], possible.scores[chain.family]
            others = [one for other in chosen if other is not chain for one in other.candidates]
            taken = list(set(others) - set(chain.candidates))
            alike = np.isin(rows, chain.candidates).sum(axis=1) >= len(chain.candidates) - _EXCHANGED
            rows, scores = (of_all[alike & ~np.isin(rows, taken).any(axis=1)] for of_all in (rows, scores))
            if len(rows):
                best = int(np.argmax(scores + more * weights[rows].sum(axis=1)))
                chosen[index] = CandidateChain(tuple(rows[best].tolist()), chain.family, float(scores[best]))
        return tuple(chosen)

    def _without_shorter_catheters(
        self, possible: PossibleChains, points_uv: Array, seen: ImageEvidence, families: tuple[CatheterFamily, ...]
    ) -> PossibleChains:
        if not self.acceptance.strict or all(family.catheter.electrodes < MANY_ELECTRODES for family in families):
            return possible
        contrast = seen.likeness.at(points_uv)
        odds = np.where(self._is_seen(points_uv), seen.kind_odds_at(points_uv), EVEN_ODDS)
        return without_shorter_catheters(possible, families, contrast, odds, self.acceptance.faded_price)

    def _fit(
        self,
        x: Image,
        seen: ImageEvidence,
        proposed: Proposals,
        linking: _Linking,
        families: tuple[CatheterFamily, ...],
    ) -> _FittedSet:
        """Fit linked chains to the image, and drop those that are not accepted."""
        fitted = fit_chains(
            x, linking.points_uv, linking.chains, shaft_image_of(seen, self.px_per_mm), families, seen.position_noise,
            linking.proposed, seen.tip_logits_at, self._is_seen(linking.points_uv),
        )  # fmt: skip
        clear = [
            _Clear(candidates, one, self._where_surest(one.chain, linking.points_uv[list(candidates.candidates)], seen))
            for candidates, one in zip(linking.chains, fitted, strict=True)
            if one.clearness >= self.acceptance.least_clearness
        ]
        result = self._accepted(clear, seen, proposed, families, beside=False)
        if self.acceptance.scores_beside is not None and result.chains and len(result.chains) < len(clear):
            more = self._accepted(clear, seen, proposed, families, beside=True)
            result = more if len(more.chains) > len(result.chains) else result
        return result

    def _where_surest(self, chain: Chain, candidates_uv: Array, seen: ImageEvidence) -> Chain:
        """Return a fitted chain with electrodes at their candidates where these are surer.

        The fit of a band may go astray: thin rings that are seen obliquely are darkest at the ends of their openings.
        """
        if not self.acceptance.strict:
            return chain
        forth, back = (np.abs(places - chain.pixels_uv).sum() for places in (candidates_uv, candidates_uv[::-1]))
        places = candidates_uv if forth <= back else candidates_uv[::-1]
        of_candidates, of_fit = answers_for_each(seen.scores_at, [places, chain.pixels_uv])
        surer = (of_candidates > of_fit) & self._is_seen(places)
        return replace(chain, pixels_uv=np.where(surer[:, None], places, chain.pixels_uv))

    def _accepted(
        self,
        clear: Sequence[_Clear],
        seen: ImageEvidence,
        proposed: Proposals,
        families: tuple[CatheterFamily, ...],
        beside: bool,
    ) -> _FittedSet:
        """Return the accepted ones of clear chains.

        beside : whether the image shows another catheter.
        """
        floor = min(family.floor for family in families)
        sure = any(
            one.fitted.clearness >= self.acceptance.sure_clearness and one.fitted.chain.scores[0] >= floor
            for one in clear
        )
        all_scores = answers_for_each(partial(self._scores_in_field, seen), [one.judged.pixels_uv for one in clear])
        accepted, judged = [], []
        for one, scores in zip(clear, all_scores, strict=True):
            chain = one.fitted.chain
            others = [other.fitted.chain for other in clear if other is not one]
            if self.acceptance.accepts(scores, chain.scores[0], beside) or self._judge.hides_a_pair(
                one.judged, scores, proposed
            ):
                covariance = ellipse.beside_other_electrodes(chain, others, self.px_per_mm)
                shown = np.where(np.isnan(scores), UNSEEN, scores)
                accepted.append((one.candidates, replace(chain, covariance_px2=covariance, scores=shown)))
                judged.append(replace(one.judged, scores=shown))
        listed = np.ones(len(accepted), np.bool_)
        if self.acceptance.strict:
            listed = self._judge.are_of_catalogue(tuple(judged), seen, proposed)
        return _FittedSet(
            tuple(chain for (_, chain), kept in zip(accepted, listed, strict=True) if kept),
            tuple(candidates for (candidates, _), kept in zip(accepted, listed, strict=True) if kept),
            tuple(candidates for (candidates, _), kept in zip(accepted, listed, strict=True) if not kept),
            sure,
        )

    def _link_without_rejected(
        self, seen: ImageEvidence, linking: _Linking, result: _FittedSet, families: tuple[CatheterFamily, ...]
    ) -> _Linking:
        """Link again without the chains that would be rejected.

        They took the places of catheters. A chain that only now gets its place must be good for itself. It has no electrode
        of an unlisted catheter, unless it has more electrodes than the chain that was part of one.
        """
        scores = self._scores_in_field(seen, linking.points_uv)
        allowed = []
        for index, (family, rows, chain_scores) in enumerate(
            zip(families, linking.possible.rows, linking.possible.scores, strict=True)
        ):
            good = chain_scores >= family.floor + _GOOD_ALONE
            good &= self.acceptance.accepts(scores[rows], chain_scores, beside=bool(result.candidates))
            unlisted = [one.candidates for one in result.unlisted if len(one.candidates) >= rows.shape[1]]
            good &= ~np.isin(rows, [candidate for candidates in unlisted for candidate in candidates]).any(axis=1)
            for chain in linking.chains:
                if chain.family == index:
                    good[(rows == np.array(chain.candidates)).all(axis=1)] = chain in result.candidates
            allowed.append(good)
        possible = linking.possible.where(allowed)
        chains = best_chains(possible, linking.points_uv, families, self.px_per_mm, linking.proposed, linking.is_merged)
        return replace(linking, possible=possible, chains=chains)

    def _is_complete(self, linked: Sequence[CandidateChain], weights: Array) -> bool:
        """Return whether each catheter has a well-fitting chain.

        The chain scores nearly as much as its candidates.
        """
        if len(linked) < len(self.catalogue.catheters):
            return False
        return all(chain.score >= weights[list(chain.candidates)].sum() - _WORST_FIT for chain in linked)

    def find_again(
        self,
        x: Image,
        chain: Chain,
        shift: Array,
        reach_px: float,
        taken: Sequence[Chain],
        frame: int | None = None,
        same_shape: bool = False,
        confirmed: bool = False,
    ) -> Chain | None:
        """Return another frame's chain at its place in this image.

        None when the image does not show it. A rigid search gives a first guess, which is refined. The refined
        positions are weighed against the guess:

        - An electrode that the refinement moves by more than 5 px stays at the guess with a larger covariance.
        - An electrode behind another catheter is predicted from the others, of which there must be two.

        None means that the image does not support the chain.
        """
        family = self.family_of(chain)
        if family is None:
            return None
        seen = self.image_evidence(x)
        guess = rigid_search(seen.likeness, chain.pixels_uv, shift, reach_px, taken, self.px_per_mm)
        hidden = are_hidden(guess, taken, self.px_per_mm) | ~self._is_seen(guess)
        if np.count_nonzero(~hidden) < _LEAST_FREE:
            return None
        place = refine(
            x,
            guess[None],
            family.catheter,
            self.px_per_mm,
            seen.position_noise,
            hidden[None],
            np.zeros((1, len(guess)), np.bool_),
        )
        points, covariance = ellipse.weighed_with_shape(
            guess, place.points_uv[0], place.covariance_px2[0], chain.covariance_px2, reach_px
        )
        # Shape and clearness come before the scores: they need no pass of a network.
        is_seen = self._is_seen(points)
        if not shows_enough(is_seen) or place.clearness[0] < self.acceptance.again_clearness:
            return None
        if same_shape and not is_same_shape(points, chain.pixels_uv):
            return None
        scores, variance = seen.scores_at(points), seen.variance_at(points)
        weights = self._evidence(seen.probability_at(points))
        for values in (scores, weights, variance) if hidden.any() else ():
            values[hidden] = np.median(values[~hidden])
        score = chain_score(points, weights, variance, shaft_image_of(seen, self.px_per_mm), family)
        # Half an electrode at the edge cannot be located.
        scores[~are_in(self.field.with_edge, points)] = UNSEEN
        in_view = confirmed and np.mean(seen.likeness.at(points[is_seen])) >= _CONFIRMED_CONTRAST
        if score < family.floor - _AGAIN_SLACK and not in_view:
            return None
        # The search keeps the order of the electrodes, so that it says nothing about the tip.
        again = replace(
            chain, pixels_uv=points, covariance_px2=covariance, scores=scores, manual=False, tip_odds=None
        )  # fmt: skip
        return replace(again, covariance_px2=ellipse.beside_other_electrodes(again, taken, self.px_per_mm))

    def find_moving(self, images: Sequence[Image], times_ms: Array, middle: int, frame: int) -> tuple[Chain, ...]:
        """Return the chains that moved means show, most probable first.

        A velocity that is wrong for a catheter blurs it: among chains at one place the most probable has the right velocity. A long
        row of faint electrodes comes before a few of them, which may be clearer than all.
        """
        found: list[tuple[bool, float, Chain]] = []
        for x in moved_means(images, times_ms, middle, self.px_per_mm):
            self.forget_image()
            chains = self.find_chains(x, frame).chains
            seen = self.image_evidence(x)
            for chain in chains:
                odds = float(np.median(log_odds(seen.probability_at(chain.pixels_uv))))
                faint = np.median(seen.likeness.at(chain.pixels_uv)) < _FAINT_CONTRAST
                faint_row = bool(faint) and len(chain.electrodes) >= MANY_ELECTRODES
                if odds >= (_LEAST_ROW_ODDS if faint_row else _LEAST_MOVING_ODDS):
                    found.append((faint_row, odds, chain))
        best: list[Chain] = []
        for _, _, chain in sorted(found, key=lambda one: one[:2], reverse=True):
            shared = (_away(chain.pixels_uv, other.pixels_uv) < HIDING_MM * self.px_per_mm for other in best)
            if all(np.count_nonzero(near) < 2 for near in shared):
                best.append(chain)
        return tuple(best)

    def shows_extra_catheter(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Return whether the image clearly shows a catheter besides these chains."""
        seen = self.image_evidence(x)
        proposed = seen.proposals(self.field.candidates, 2)
        if self.acceptance.strict:
            sure = proposed.points_uv[proposed.probability >= SURE]
            return shows_row(not_on(sure, chains, self.px_per_mm), self.px_per_mm)
        if len(chains) < len(self.catalogue.catheters):
            return False
        taken = np.concatenate([chain.pixels_uv for chain in chains])
        away = np.linalg.norm(proposed.points_uv[:, None] - taken[None], axis=2).min(axis=1)
        free = away > _BESIDE_MM * self.px_per_mm
        points, weights = proposed.points_uv[free], self._evidence(proposed.probability[free])
        families = catheter_families(self.catalogue)
        shaft_image = shaft_image_of(seen, self.px_per_mm)
        linked = link_candidates(points, weights, proposed.variance_px2[free], shaft_image, families)
        fitted = fit_chains(x, points, linked, shaft_image, families, seen.position_noise)
        return any(one.clearness >= self.acceptance.extra_clearness for one in fitted)

    def _is_seen(self, points_uv: Array) -> BoolArray:
        """Return which points lie in the field, (n,)."""
        return are_in(self.field.inside, points_uv)

    def _scores_in_field(self, seen: ImageEvidence, points_uv: Array) -> Array:
        """Return how clearly electrodes show at points, NaN outside the field, (n,)."""
        return np.where(self._is_seen(points_uv), seen.scores_at(points_uv), np.nan)

    def family_of(self, chain: Chain) -> CatheterFamily | None:
        """Return the most probable family whose catheters have exactly this chain's electrodes."""
        return family_of(chain, self.catalogue)


def _is_doubtful(chain: Chain, seen: ImageEvidence) -> bool:
    """Return whether a long chain has a place that is clearly no electrode."""
    places = chain.pixels_uv[chain.scores > UNSEEN]
    return len(chain.electrodes) >= MANY_ELECTRODES and bool((seen.kind_odds_at(places) < NO_ELECTRODE).any())


def _away(points_uv: Array, from_uv: Array) -> Array:
    """Return the distance of each point to the nearest of others, (n,)."""
    nearest: Array = np.linalg.norm(points_uv[:, None] - from_uv[None], axis=2).min(axis=1)
    return nearest


def with_whole_places(
    possible: PossibleChains, points_uv: Array, families: Sequence[CatheterFamily], first_half: int, halves: int
) -> PossibleChains:
    """Return the chains that show at least four separate places.

    The ``halves`` candidates from ``first_half`` on are electrodes of split pairs: two of them are one place, and a chain that has
    one pays for having the candidate that was split too. Later candidates were not proposed. Three drops of contrast medium may
    lie like a pair and two rings.
    """
    if not halves:
        return possible
    last = first_half + halves
    place = np.arange(len(points_uv))
    apart = points_uv[first_half:last, None] - points_uv[:first_half]
    place[first_half:last] = np.argmin((apart * apart).sum(axis=2), axis=1)
    allowed, scores = [], []
    for family, rows, of_family in zip(families, possible.rows, possible.scores, strict=True):
        is_half = (rows >= first_half) & (rows < last)
        places = np.sort(np.where(rows < last, place[rows], -1), axis=1)
        separate = (places[:, :1] >= 0).sum(axis=1) + (np.diff(places, axis=1) > 0).sum(axis=1)
        twice = ((rows[:, :, None] == place[rows][:, None, :]) & is_half[:, None, :]).any(axis=1).sum(axis=1)
        priced = of_family - _TWICE * twice
        few = is_half.any(axis=1) & (separate < min(_LEAST_PLACES, rows.shape[1]))
        allowed.append(~few & ((twice == 0) | (priced >= family.floor - _COMPANION_SLACK)))
        scores.append(priced)
    return PossibleChains(possible.rows, tuple(scores)).where(allowed)
