"""One image -> its chains: proposals, linking and refinement in a row; and chains that were seen before."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, BoolArray, Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.field_mask import FieldMask
from fluoromap.segmenter.linking import Family, Linked, Shafts, Trust, chain_score, evidence, families, link
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.placing import place_chains, widened_covariance
from fluoromap.segmenter.proposals import ImageEvidence, Proposals, Proposer
from fluoromap.segmenter.refinement import refine
from fluoromap.segmenter.rigid_search import rigid_search
from fluoromap.segmenter.unlisted import SURE, continues, not_on, unexplained_between
from fluoromap.segmenter.unseen_electrodes import complete

_LEAST_LINE, _LINE_NOISE = 0.03, 0.6
_COMPANION_SLACK = 2.5
_CARRIED_SLACK = 2.5
_STRAYED_PX = 5.0
_HIDING_MM, _LEAST_FREE = 1.2, 2
_FITS = 2.0
_BENDING = 0.12
_BESIDE_MM = 2.0


@dataclass(frozen=True, slots=True)
class Acceptance:
    """How sure chains have to be, in the measures of one proposer.

    least_clearness, carried_clearness : of :attr:`~fluoromap.segmenter.refinement.Refined.clearness`, of a chain found in its
    image and of one carried there. sure_clearness : one chain of an image has to reach it. extra_clearness : a catheter beside
    those of the catalogue is reported from here on. least_score : of the median of a chain's scores. seen_score, least_seen :
    at least this share of a chain's electrodes has this score. unseen_evidence : an electrode that was not proposed is predicted
    only where there is more :func:`~fluoromap.segmenter.linking.evidence` than this. strict : a chain is not accepted as a
    catheter of the catalogue where sure proposals lie between its electrodes, or go on in its line. trust : see
    :class:`~fluoromap.segmenter.linking.Trust`.
    """

    least_clearness: float
    carried_clearness: float
    sure_clearness: float
    extra_clearness: float
    least_score: float
    seen_score: float = -np.inf
    least_seen: float = 0.0
    unseen_evidence: float = 0.0
    strict: bool = False
    trust: Trust = Trust()

    def accepts(self, scores: Array) -> bool:
        """Whether a chain's scores are enough, (electrodes,)."""
        return bool(np.median(scores) >= self.least_score and np.mean(scores >= self.seen_score) >= self.least_seen)


@dataclass(slots=True, eq=False)
class ChainDetector:
    """Finds chains in the images of one run, whose field and scale are fixed. Keeps what it knows of the last image."""

    catalogue: Catalogue
    field: FieldMask
    px_per_mm: float
    proposer: Proposer
    acceptance: Acceptance
    _last: tuple[Image, ImageEvidence] | None = dataclasses.field(default=None, init=False, repr=False)

    def evidence(self, x: Image) -> ImageEvidence:
        """What the proposer knows about a log image."""
        if self._last is None or self._last[0] is not x:
            self._last = x, self.proposer(x)
        return self._last[1]

    def chains(self, x: Image, frame: int) -> FrameChains:
        """Chains of one log image, or why there are none.

        One chain has to be above its family's floor and look like electrodes clearly. Then weaker ones are believed beside it;
        alone, they come with ``manual_needed``.
        """
        if min(x.shape) < 16:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        seen = self.evidence(x)
        electrodes = sum(catheter.electrodes for catheter in self.catalogue.catheters)
        proposed = seen.proposals(self.field.candidates, max(2, electrodes // 2))
        points, weights, variance = proposed.points_uv, evidence(proposed.probability, self.acceptance.trust), proposed.variance_px2
        kinds = families(self.catalogue)
        shafts = self._shafts(seen)
        sound = len(points)
        linked = link(points, weights, variance, shafts, kinds, slack=_COMPANION_SLACK)
        if not self._settled(linked, weights):

            def dark(places: Array) -> Array:
                probability = seen.unseen_probability_at(places)
                return np.where(self._in_field(places) & (probability > 0), evidence(probability, self.acceptance.trust), -np.inf)

            more = complete(
                points, weights, variance, dark, self.acceptance.unseen_evidence, kinds, self.px_per_mm
            )
            linked = link(
                more.points_uv, more.weights, more.variance_px2, shafts, kinds, len(points), _COMPANION_SLACK, more.rows
            )
            points = more.points_uv
        if not linked:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        placed = [
            one
            for one in place_chains(x, points, linked, shafts, kinds, seen.pixel_noise, sound)
            if one.clearness >= self.acceptance.least_clearness
        ]
        floor = min(family.floor for family in kinds)
        sure = any(one.clearness >= self.acceptance.sure_clearness and one.chain.scores[0] >= floor for one in placed)
        found = [one.chain for one in placed]
        chains = tuple(
            replace(
                chain,
                covariance_px2=widened_covariance(
                    chain, [other for other in found if other is not chain], self.px_per_mm
                ),
                scores=seen.scores_at(chain.pixels_uv),
            )
            for chain in found
        )
        chains = tuple(chain for chain in chains if self.acceptance.accepts(chain.scores))
        if self.acceptance.strict:
            chains = self._of_catalogue(chains, proposed)
        return FrameChains(frame, chains, None if sure and chains else Reason.MANUAL_NEEDED)

    def _of_catalogue(self, chains: tuple[Chain, ...], proposed: Proposals) -> tuple[Chain, ...]:
        """The chains that are not part of a catheter with more electrodes than the catalogue has."""
        sure = proposed.points_uv[proposed.probability >= SURE]
        free = not_on(sure, chains, self.px_per_mm)
        kept = []
        for chain in chains:
            family = self._family(chain)
            between = unexplained_between(chain, free, self.px_per_mm)
            if family is not None and between == 0 and not continues(chain, sure, family.catheter, self.px_per_mm):
                kept.append(chain)
        return tuple(kept)

    def _settled(self, linked: Sequence[Linked], weights: Array) -> bool:
        """Whether there is a chain of its own candidates for each catheter, none of them much worse than its candidates are."""
        if len(linked) < len(self.catalogue.catheters):
            return False
        return all(chain.score >= weights[list(chain.candidates)].sum() - _FITS for chain in linked)

    def carried(self, x: Image, chain: Chain, shift: Array, reach_px: float, taken: Sequence[Chain]) -> Chain | None:
        """A chain seen before, found again by a rigid search and refined; None where the image does
        not support it. What refinement measures is weighed against where the search put it; an electrode that it
        moves by more than 5 px stays there, less sure; one that another catheter hides is put where the others have it,
        of which there must be two."""
        family = self._family(chain)
        if family is None:
            return None
        seen = self.evidence(x)
        guess = rigid_search(seen.likeness, chain.pixels_uv, shift, reach_px, taken, self.px_per_mm)
        hidden = np.zeros(len(guess), np.bool_)
        for other in taken:
            near = np.linalg.norm(guess[:, None] - other.pixels_uv[None], axis=2).min(axis=1)
            hidden |= near < _HIDING_MM * self.px_per_mm
        if np.count_nonzero(~hidden) < _LEAST_FREE:
            return None
        place = refine(
            x,
            guess[None],
            family.catheter,
            self.px_per_mm,
            seen.pixel_noise,
            hidden[None],
            np.zeros((1, len(guess)), np.bool_),
        )
        found = place.points_uv[0]
        strayed = np.linalg.norm(found - guess, axis=1) > _STRAYED_PX
        covariance = np.where(strayed[:, None, None], (4 * _STRAYED_PX) ** 2 * np.eye(2), place.covariance_px2[0])
        expected = chain.covariance_px2 + (_BENDING * reach_px) ** 2 * np.eye(2)
        gain = expected @ np.linalg.inv(expected + covariance)
        points = guess + np.einsum("nij,nj->ni", gain, found - guess)
        covariance = gain @ covariance
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        if not self._in_field(points).all():
            return None
        scores, weights, variance = seen.scores_at(points), evidence(seen.probability_at(points), self.acceptance.trust), seen.variance_at(points)
        for values in (scores, weights, variance) if hidden.any() else ():
            values[hidden] = np.median(values[~hidden])
        score = chain_score(points, weights, variance, self._shafts(seen), family)
        if score < family.floor - _CARRIED_SLACK or place.clearness[0] < self.acceptance.carried_clearness:
            return None
        carried = replace(chain, pixels_uv=points, covariance_px2=covariance, scores=scores, manual=False)
        return replace(carried, covariance_px2=widened_covariance(carried, taken, self.px_per_mm))

    def extra(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Whether one more catheter of the catalogue's kinds shows clearly beside these chains."""
        seen = self.evidence(x)
        proposed = seen.proposals(self.field.candidates, 2)
        taken = np.concatenate([chain.pixels_uv for chain in chains])
        away = np.linalg.norm(proposed.points_uv[:, None] - taken[None], axis=2).min(axis=1)
        free = away > _BESIDE_MM * self.px_per_mm
        points = proposed.points_uv[free]
        kinds = families(self.catalogue)
        shafts = self._shafts(seen)
        linked = link(points, evidence(proposed.probability[free], self.acceptance.trust), proposed.variance_px2[free], shafts, kinds)
        placed = place_chains(x, points, linked, shafts, kinds, seen.pixel_noise)
        return any(one.clearness >= self.acceptance.extra_clearness for one in placed)

    def _in_field(self, points_uv: Array) -> BoolArray:
        """Which points lie where electrodes may be, (n,)."""
        rows, columns = self.field.candidates.shape
        u, v = np.rint(points_uv).astype(np.int64).T
        within = (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
        inside: BoolArray = within & self.field.candidates[np.clip(v, 0, rows - 1), np.clip(u, 0, columns - 1)]
        return inside

    def _family(self, chain: Chain) -> Family | None:
        """The most probable family whose catheters have exactly this chain's electrodes."""
        whole = [
            family
            for family in families(self.catalogue)
            if chain.electrodes == tuple(range(1, family.catheter.electrodes + 1))
        ]
        return max(whole, key=lambda family: sum(chain.probability(name) for name in family.names), default=None)

    def _shafts(self, seen: ImageEvidence) -> Shafts:
        clear = max(_LEAST_LINE, _LINE_NOISE * seen.pixel_noise)
        return Shafts(seen.smooth, seen.reduction, clear, self.px_per_mm)
