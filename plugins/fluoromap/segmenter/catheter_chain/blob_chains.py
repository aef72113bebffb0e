"""One image -> its chains by blobs: candidates, linking and refinement in a row; and chains that were seen before."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, BoolArray, Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.catheter_chain.blob_response import BlobResponse
from fluoromap.segmenter.catheter_chain.rigid_search import rigid_search
from fluoromap.segmenter.field_mask import FieldMask
from fluoromap.segmenter.linking import Family, Linked, Shafts, chain_score, evidence, families, link
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.placing import place_chains, widened_covariance
from fluoromap.segmenter.refinement import refine
from fluoromap.segmenter.unseen_electrodes import complete

_BLUR_MM = 1.75
_LEAST_LINE, _LINE_NOISE = 0.03, 0.6
_COMPANION_SLACK = 2.5
_SURE_CLEARNESS = 1.1
_LEAST_CLEARNESS = 0.75
_LEAST_SNR = 3.5
_CARRIED_SLACK = 2.5
_CARRIED_CLEARNESS = 0.6
_STRAYED_PX = 5.0
_HIDING_MM, _LEAST_FREE = 1.2, 2
_FITS = 2.0
_BENDING = 0.12
_BESIDE_MM, _EXTRA_CLEARNESS = 2.0, 1.3


@dataclass(slots=True, eq=False)
class BlobDetector:
    """Finds chains in the images of one run, whose field and scale are fixed. Keeps the response of the image it saw last."""

    catalogue: Catalogue
    field: FieldMask
    px_per_mm: float
    _last: tuple[Image, BlobResponse] | None = dataclasses.field(default=None, init=False, repr=False)

    def response(self, x: Image) -> BlobResponse:
        """Response of a log image to blobs of the size of this catalogue's electrodes."""
        if self._last is None or self._last[0] is not x:
            ring_mm = min(catheter.ring_mm for catheter in self.catalogue.catheters)
            self._last = x, BlobResponse.of_image(x, self.field.inside, ring_mm, self.px_per_mm)
        return self._last[1]

    def chains(self, x: Image, frame: int) -> FrameChains:
        """Chains of one log image, or why there are none.

        One chain has to be above its family's floor and look like electrodes clearly. Then weaker ones are believed beside it;
        alone, they come with ``manual_needed``.
        """
        if min(x.shape) < 16:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        response = self.response(x)
        electrodes = sum(catheter.electrodes for catheter in self.catalogue.catheters)
        points, snr = response.candidates(self.field.candidates, max(2, electrodes // 2))
        kinds = families(self.catalogue)
        shafts = self._shafts(response)
        weights, variance = evidence(snr), self._variance(snr)
        sound = len(points)
        linked = link(points, weights, variance, shafts, kinds, slack=_COMPANION_SLACK)
        if not self._settled(linked, weights):

            def dark(places: Array) -> Array:
                return np.where(self._in_field(places), evidence(response.at(places)), -1.0)

            more = complete(points, weights, variance, dark, kinds, self.px_per_mm)
            linked = link(
                more.points_uv, more.weights, more.variance_px2, shafts, kinds, len(points), _COMPANION_SLACK, more.rows
            )
            points = more.points_uv
        if not linked:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        placed = [
            one
            for one in place_chains(x, points, linked, shafts, kinds, response.pixel_noise, sound)
            if one.clearness >= _LEAST_CLEARNESS
        ]
        floor = min(family.floor for family in kinds)
        sure = any(one.clearness >= _SURE_CLEARNESS and one.chain.scores[0] >= floor for one in placed)
        found = [one.chain for one in placed]
        chains = tuple(
            replace(
                chain,
                covariance_px2=widened_covariance(
                    chain, [other for other in found if other is not chain], self.px_per_mm
                ),
                scores=response.at(chain.pixels_uv),
            )
            for chain in found
        )
        chains = tuple(chain for chain in chains if np.median(chain.scores) >= _LEAST_SNR)
        return FrameChains(frame, chains, None if sure and chains else Reason.MANUAL_NEEDED)

    def _settled(self, linked: Sequence[Linked], weights: Array) -> bool:
        """Whether there is a chain of its own candidates for each catheter, none of them much worse than its candidates are."""
        if len(linked) < len(self.catalogue.catheters):
            return False
        return all(chain.score >= weights[list(chain.candidates)].sum() - _FITS for chain in linked)

    def carried(self, x: Image, chain: Chain, shift: Array, reach_px: float, taken: Sequence[Chain]) -> Chain | None:
        """A chain seen before, found again by a rigid search on the blob response and refined; None where the image does
        not support it. What refinement measures is weighed against where the search put it; an electrode that it
        moves by more than 5 px stays there, less sure; one that another catheter hides is put where the others have it,
        of which there must be two."""
        family = self._family(chain)
        if family is None:
            return None
        response = self.response(x)
        guess = rigid_search(response, chain.pixels_uv, shift, reach_px, taken)
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
            response.pixel_noise,
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
        snr = response.at(points)
        if hidden.any():
            snr[hidden] = np.median(snr[~hidden])
        score = chain_score(points, evidence(snr), self._variance(snr), self._shafts(response), family)
        if score < family.floor - _CARRIED_SLACK or place.clearness[0] < _CARRIED_CLEARNESS:
            return None
        carried = replace(chain, pixels_uv=points, covariance_px2=covariance, scores=snr, manual=False)
        return replace(carried, covariance_px2=widened_covariance(carried, taken, self.px_per_mm))

    def extra(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Whether one more catheter of the catalogue's kinds shows clearly beside these chains."""
        response = self.response(x)
        points, snr = response.candidates(self.field.candidates, 2)
        taken = np.concatenate([chain.pixels_uv for chain in chains])
        free = np.linalg.norm(points[:, None] - taken[None], axis=2).min(axis=1) > _BESIDE_MM * self.px_per_mm
        points, snr = points[free], snr[free]
        kinds = families(self.catalogue)
        shafts = self._shafts(response)
        linked = link(points, evidence(snr), self._variance(snr), shafts, kinds)
        placed = place_chains(x, points, linked, shafts, kinds, response.pixel_noise)
        return any(one.clearness >= _EXTRA_CLEARNESS for one in placed)

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

    def _shafts(self, response: BlobResponse) -> Shafts:
        clear = max(_LEAST_LINE, _LINE_NOISE * response.pixel_noise)
        return Shafts(response.smooth, response.reduction, clear, self.px_per_mm)

    def _variance(self, snr: Array) -> Array:
        """Of the place of a blob's maximum, square pixels."""
        variance: Array = (_BLUR_MM * self.px_per_mm / np.maximum(snr, 1.0)) ** 2
        return variance
