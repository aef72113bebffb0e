"""What network and blobs say together about one log image.

The network knows what is an electrode; it works at a reduced scale and is unsure in noise. Blobs have the full resolution and a
contrast over noise; they know nothing of cables and vessels. The two compete for each place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.catheter_chain.blob_response import BlobResponse
from fluoromap.segmenter.learned_chain.network_response import NetworkEvidence
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.proposals import Likeness, Proposals, log_odds, probability_of_contrast

_EVEN_SHARE = 0.5
_LEAST_PROBABILITY = 0.05
_ENOUGH_CONTRAST = 8.0
_APART_MM = 0.6
_HALF_APART_MM, _HALF_SD_MM = 0.3, 0.25
_FAINT, _CLEAR = 5.0, 9.5
FAINT_LOG_ODDS = 4.5
"""Of an electrode that is too faint for the network to be sure, where other frames confirm it."""


@dataclass(slots=True, eq=False)
class JointEvidence:
    """Network and blobs of one log image, see :class:`~fluoromap.segmenter.proposals.ImageEvidence`.

    network : may be that of the frame before. least_noise : of a pixel, for pictures of 8 bits. faint_log_odds :
    what little contrast adds to the network's log-odds in the scores. reach_cells : how far from a
    place the network's answer for it may lie.
    """

    network: NetworkEvidence
    blobs: BlobResponse
    px_per_mm: float
    least_noise: float
    faint_log_odds: float = FAINT_LOG_ODDS
    reach_cells: int = 1
    _proposed: Proposals | None = None

    @property
    def smooth(self) -> Image:
        return self.blobs.smooth

    @property
    def reduction(self) -> int:
        return self.blobs.reduction

    @property
    def pixel_noise(self) -> float:
        return max(self.blobs.pixel_noise, self.least_noise)

    @property
    def position_noise(self) -> float:
        return max(self.blobs.position_noise, self.least_noise)

    @property
    def likeness(self) -> Likeness:
        return self.blobs.likeness

    def proposals(self, allowed: BoolArray, expected: int) -> Proposals:
        """Return the electrodes where ``allowed``, most probable first."""
        self._proposed = self._compete(allowed, expected)
        return self._proposed

    def _compete(self, allowed: BoolArray, expected: int) -> Proposals:
        """Return possible blobs, and the network's proposals away from them.

        Blobs that the network excludes are left out. A blob's place is more exact, and it resolves electrodes that are one for the
        network. Places that the network proposed in another frame are not used.
        """
        blobs = self.blobs.proposals(allowed, expected)
        blobs = _taken(blobs, self.scores_at(blobs.points_uv) >= _LEAST_PROBABILITY)
        blobs = Proposals(blobs.points_uv, self.probability_at(blobs.points_uv), blobs.covariance_px2)
        if self.reach_cells > 1:
            return _taken(blobs, np.argsort(-blobs.probability, kind="stable"))
        proposed = self.network.proposals(allowed, expected)
        if len(blobs) and len(proposed):
            away = np.linalg.norm(proposed.points_uv[:, None] - blobs.points_uv[None], axis=2).min(axis=1)
            proposed = _taken(proposed, away > _APART_MM * self.px_per_mm)
        probability = np.concatenate([blobs.probability, proposed.probability])
        together = Proposals(
            np.concatenate([blobs.points_uv, proposed.points_uv]),
            probability,
            np.concatenate([blobs.covariance_px2, proposed.covariance_px2]),
        )
        return _taken(together, np.argsort(-probability, kind="stable"))

    def halves_of_pairs(self, allowed: BoolArray) -> Proposals:
        """Return both electrodes of pairs that were proposed as one.

        They lie where ``allowed``, and away from all proposals.
        """
        points = self.network.halves_of_pairs() if self.reach_cells == 1 else np.zeros((0, 2))
        column, row = np.rint(points).astype(np.int64).T
        within = (column >= 0) & (row >= 0) & (column < allowed.shape[1]) & (row < allowed.shape[0])
        points = points[within]
        points = points[allowed[row[within], column[within]]]
        if len(points) and self._proposed is not None and len(self._proposed):
            away, _ = cKDTree(self._proposed.points_uv).query(points)
            points = points[away > _HALF_APART_MM * self.px_per_mm]
        variance = (_HALF_SD_MM * self.px_per_mm) ** 2
        return Proposals(points, self.probability_at(points), np.tile(variance * np.eye(2), (len(points), 1, 1)))

    def tip_logits_at(self, points_uv: Array) -> Array:
        """Return the network's logit of a tip electrode at points, (n,)."""
        return self.network.tip_logits_at(points_uv, self.reach_cells)

    def _network_at(self, points_uv: Array) -> Array:
        return self.network.probability_at(points_uv, self.reach_cells)

    def probability_at(self, points_uv: Array) -> Array:
        """Return the probability of electrodes at points, (n,).

        Its log-odds are the mean of those of the network and twice those of the contrast.
        """
        probability: Array = 1.0 / (1.0 + np.exp(-self._odds_at(points_uv)))
        return probability

    def kind_odds_at(self, points_uv: Array) -> Array:
        """Return the log-odds by which electrodes differ from other blobs, (n,).

        They are those of :meth:`probability_at` with limited contrast: in a clear picture shafts and cables have as much contrast
        over noise as electrodes.
        """
        return self._odds_at(points_uv, _ENOUGH_CONTRAST)

    def _odds_at(self, points_uv: Array, most_contrast: float = np.inf) -> Array:
        of_network = log_odds(self._network_at(points_uv))
        contrast = np.minimum(self.blobs.scores_at(points_uv), most_contrast)
        odds: Array = _EVEN_SHARE * (of_network + 2.0 * log_odds(probability_of_contrast(contrast)))
        return odds

    def unseen_probability_at(self, points_uv: Array) -> Array:
        """Return the same, but 0 where a proposed electrode has the place."""
        probability = self.probability_at(points_uv)
        if self._proposed is not None and len(self._proposed) and len(points_uv):
            away, _ = cKDTree(self._proposed.points_uv).query(points_uv)
            probability[away < _APART_MM * self.px_per_mm] = 0.0
        return probability

    def variance_at(self, points_uv: Array) -> Array:
        """Return the variance of blobs' places at points, (n,) pixels squared."""
        return self.blobs.variance_at(points_uv)

    def scores_at(self, points_uv: Array) -> Array:
        """Return the network's probability at points, raised where little contrast excuses doubt, (n,).

        What is clearly visible and yet not clear to the network is no electrode.
        """
        contrast = self.blobs.scores_at(points_uv)
        excuse = self.faint_log_odds * np.clip((_CLEAR - contrast) / (_CLEAR - _FAINT), 0.0, 1.0)
        odds = log_odds(self._network_at(points_uv)) + excuse
        scores: Array = 1.0 / (1.0 + np.exp(-odds))
        return scores


def _taken(proposals: Proposals, which: IntArray | BoolArray) -> Proposals:
    return Proposals(proposals.points_uv[which], proposals.probability[which], proposals.covariance_px2[which])
