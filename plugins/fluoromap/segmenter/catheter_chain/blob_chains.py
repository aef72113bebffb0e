"""Chains of one image from blobs: candidates, linking, fit; and chains of other frames."""

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
from fluoromap.segmenter.chain_fitting import fit_chains, widen_covariance
from fluoromap.segmenter.field_mask import FieldMask
from fluoromap.segmenter.linking import (
    CandidateChain,
    CatheterFamily,
    ShaftImage,
    catheter_families,
    chain_score,
    evidence,
    link_candidates,
)
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.missing_electrodes import complete_chains
from fluoromap.segmenter.refinement import refine

_BLUR_MM = 1.75
_LEAST_LINE, _LINE_NOISE = 0.03, 0.6
_COMPANION_SLACK = 2.5
_SURE_CLEARNESS = 1.1
_LEAST_CLEARNESS = 0.75
_LEAST_SNR = 3.5
_AGAIN_SLACK = 2.5
_AGAIN_CLEARNESS = 0.6
_STRAY_PX = 5.0
_HIDING_MM, _LEAST_FREE = 1.2, 2
_WORST_FIT = 2.0
_BENDING = 0.12
_BESIDE_MM, _EXTRA_CLEARNESS = 2.0, 1.3


@dataclass(slots=True, eq=False)
class BlobDetector:
    """Detector of chains by blobs, for one run.

    It stores the response of the latest image.
    """

    catalogue: Catalogue
    field: FieldMask
    px_per_mm: float
    _latest: tuple[Image, BlobResponse] | None = dataclasses.field(default=None, init=False, repr=False)

    def response(self, x: Image) -> BlobResponse:
        """Return the response of a log image to blobs of this catalogue's electrodes."""
        if self._latest is None or self._latest[0] is not x:
            ring_mm = min(catheter.ring_mm for catheter in self.catalogue.catheters)
            self._latest = x, BlobResponse.of_image(x, self.field.inside, ring_mm, self.px_per_mm)
        return self._latest[1]

    def find_chains(self, x: Image, frame: int) -> FrameChains:
        """Return the chains of one log image, or the reason why there are none.

        One chain must exceed its family's floor and clearly look like electrodes. Then weaker chains beside it are accepted
        too.
        Weaker chains alone come with ``manual_needed``.
        """
        if min(x.shape) < 16:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        response = self.response(x)
        electrodes = sum(catheter.electrodes for catheter in self.catalogue.catheters)
        points, snr = response.candidates(self.field.candidates, max(2, electrodes // 2))
        families = catheter_families(self.catalogue)
        shaft_image = self._shafts(response)
        weights, variance = evidence(snr), self._variance(snr)
        sure_candidates = len(points)
        linked = link_candidates(points, weights, variance, shaft_image, families, slack=_COMPANION_SLACK)
        if not self._is_complete(linked, weights):

            def dark(places: Array) -> Array:
                return np.where(self._in_field(places), evidence(response.at(places)), -1.0)

            completed = complete_chains(points, weights, variance, dark, families, self.px_per_mm)
            linked = link_candidates(
                completed.points_uv,
                completed.weights,
                completed.variance_px2,
                shaft_image,
                families,
                len(points),
                _COMPANION_SLACK,
                completed.rows,
            )
            points = completed.points_uv
        if not linked:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        fitted = [
            one
            for one in fit_chains(x, points, linked, shaft_image, families, response.pixel_noise, sure_candidates)
            if one.clearness >= _LEAST_CLEARNESS
        ]
        floor = min(family.floor for family in families)
        sure = any(one.clearness >= _SURE_CLEARNESS and one.chain.scores[0] >= floor for one in fitted)
        found = [one.chain for one in fitted]
        chains = tuple(
            replace(
                chain,
                covariance_px2=widen_covariance(
                    chain, [other for other in found if other is not chain], self.px_per_mm
                ),
                scores=response.at(chain.pixels_uv),
            )
            for chain in found
        )
        chains = tuple(chain for chain in chains if np.median(chain.scores) >= _LEAST_SNR)
        return FrameChains(frame, chains, None if sure and chains else Reason.MANUAL_NEEDED)

    def _is_complete(self, linked: Sequence[CandidateChain], weights: Array) -> bool:
        """Return whether each catheter has a well-fitting chain.

        The chain scores nearly as much as its candidates.
        """
        if len(linked) < len(self.catalogue.catheters):
            return False
        return all(chain.score >= weights[list(chain.candidates)].sum() - _WORST_FIT for chain in linked)

    def find_again(self, x: Image, chain: Chain, shift: Array, reach_px: float, taken: Sequence[Chain]) -> Chain | None:
        """Return a chain of another frame at its place in this image, or None.

        A rigid search on the blob response gives a first guess, which is refined. The refined positions are weighed against
        the guess:

        - An electrode that the refinement moves by more than 5 px stays at the guess with a larger covariance.
        - An electrode behind another catheter is predicted from the others, of which there must be two.

        None means that the image does not support the chain.
        """
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
        is_stray = np.linalg.norm(found - guess, axis=1) > _STRAY_PX
        covariance = np.where(is_stray[:, None, None], (4 * _STRAY_PX) ** 2 * np.eye(2), place.covariance_px2[0])
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
        if score < family.floor - _AGAIN_SLACK or place.clearness[0] < _AGAIN_CLEARNESS:
            return None
        again = replace(chain, pixels_uv=points, covariance_px2=covariance, scores=snr, manual=False)
        return replace(again, covariance_px2=widen_covariance(again, taken, self.px_per_mm))

    def shows_extra_catheter(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Return whether the image clearly shows a catheter besides these chains."""
        response = self.response(x)
        points, snr = response.candidates(self.field.candidates, 2)
        taken = np.concatenate([chain.pixels_uv for chain in chains])
        free = np.linalg.norm(points[:, None] - taken[None], axis=2).min(axis=1) > _BESIDE_MM * self.px_per_mm
        points, snr = points[free], snr[free]
        families = catheter_families(self.catalogue)
        shaft_image = self._shafts(response)
        linked = link_candidates(points, evidence(snr), self._variance(snr), shaft_image, families)
        fitted = fit_chains(x, points, linked, shaft_image, families, response.pixel_noise)
        return any(one.clearness >= _EXTRA_CLEARNESS for one in fitted)

    def _in_field(self, points_uv: Array) -> BoolArray:
        """Return which points lie where electrodes may be, (n,)."""
        rows, columns = self.field.candidates.shape
        u, v = np.rint(points_uv).astype(np.int64).T
        within = (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
        inside: BoolArray = within & self.field.candidates[np.clip(v, 0, rows - 1), np.clip(u, 0, columns - 1)]
        return inside

    def _family(self, chain: Chain) -> CatheterFamily | None:
        """Return the most probable family whose catheters have exactly this chain's electrodes."""
        whole = [
            family
            for family in catheter_families(self.catalogue)
            if chain.electrodes == tuple(range(1, family.catheter.electrodes + 1))
        ]
        return max(whole, key=lambda family: sum(chain.probability(name) for name in family.names), default=None)

    def _shafts(self, response: BlobResponse) -> ShaftImage:
        clear = max(_LEAST_LINE, _LINE_NOISE * response.pixel_noise)
        return ShaftImage(response.smooth, response.reduction, clear, self.px_per_mm)

    def _variance(self, snr: Array) -> Array:
        """Return the variance of the places of blob maxima, square pixels."""
        variance: Array = (_BLUR_MM * self.px_per_mm / np.maximum(snr, 1.0)) ** 2
        return variance
