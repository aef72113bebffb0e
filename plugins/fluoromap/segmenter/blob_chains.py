"""One image -> its chains by blobs: candidates, linking and refinement in a row; and chains that were seen before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.blob_response import BlobResponse
from fluoromap.segmenter.field_mask import FieldMask
from fluoromap.segmenter.linking import Family, Shafts, chain_score, evidence, families, link
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.placing import place_chains
from fluoromap.segmenter.refinement import refine
from fluoromap.segmenter.rigid_search import rigid_search

_BLUR_MM = 1.75
_LEAST_LINE, _LINE_NOISE = 0.03, 0.6
_COMPANION_SLACK = 2.5
_SURE_CLEARNESS = 1.1
_LEAST_CLEARNESS = 0.75
_CARRIED_SLACK = 2.5
_CARRIED_CLEARNESS = 0.6
_STRAYED_PX = 5.0
_HIDING_MM = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class BlobDetector:
    """Finds chains in the images of one run, whose field and scale are fixed."""

    catalogue: Catalogue
    field: FieldMask
    px_per_mm: float

    def response(self, x: Image) -> BlobResponse:
        """Response of a log image to blobs of the size of this catalogue's electrodes."""
        ring_mm = min(catheter.ring_mm for catheter in self.catalogue.catheters)
        return BlobResponse.of_image(x, self.field.inside, ring_mm, self.px_per_mm)

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
        linked = link(points, evidence(snr), self._variance(snr), shafts, kinds, slack=_COMPANION_SLACK)
        if not linked:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        placed = [one for one in place_chains(x, points, linked, shafts, kinds) if one.clearness >= _LEAST_CLEARNESS]
        floor = min(family.floor for family in kinds)
        sure = any(one.clearness >= _SURE_CLEARNESS and one.chain.scores[0] >= floor for one in placed)
        chains = tuple(replace(one.chain, scores=response.at(one.chain.pixels_uv)) for one in placed)
        return FrameChains(frame, chains, None if sure else Reason.MANUAL_NEEDED)

    def carried(self, x: Image, chain: Chain, shift: Array, reach_px: float, taken: Sequence[Chain]) -> Chain | None:
        """A chain seen before, found again by a rigid search on the blob response and refined; None where the image does
        not support it. An electrode that refinement moves by more than 5 px stays where the search put it, less sure; one
        that another catheter hides is put where the others have it."""
        family = self._family(chain)
        if family is None:
            return None
        response = self.response(x)
        guess = rigid_search(response, chain.pixels_uv, shift, reach_px, taken)
        near = np.array([np.linalg.norm(guess[:, None] - other.pixels_uv[None], axis=2).min(axis=1) for other in taken])
        hidden = (
            np.flatnonzero((near < _HIDING_MM * self.px_per_mm).any(axis=0)) if len(taken) else np.zeros(0, np.int64)
        )
        place = refine(x, guess, family.catheter, self.px_per_mm, hidden.tolist())
        strayed = np.linalg.norm(place.points_uv - guess, axis=1) > _STRAYED_PX
        points = np.where(strayed[:, None], guess, place.points_uv)
        covariance = np.where(strayed[:, None, None], (_STRAYED_PX / 2) ** 2 * np.eye(2), place.covariance_px2)
        u, v = np.rint(points).astype(np.int64).T
        rows, columns = self.field.candidates.shape
        if u.min() < 0 or v.min() < 0 or u.max() >= columns or v.max() >= rows or not self.field.candidates[v, u].all():
            return None
        snr = response.at(points)
        if 0 < len(hidden) < len(snr):
            snr[hidden] = np.median(np.delete(snr, hidden))
        score = chain_score(points, evidence(snr), self._variance(snr), self._shafts(response), family)
        if score < family.floor - _CARRIED_SLACK or place.clearness < _CARRIED_CLEARNESS:
            return None
        return replace(chain, pixels_uv=points, covariance_px2=covariance, scores=snr, manual=False)

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
