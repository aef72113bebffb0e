"""What network and blobs say together about one log image.

The network knows what is an electrode; it works at a reduced scale and is unsure in noise. Blobs have the full resolution and a
contrast over noise; they know nothing of cables and vessels. The two compete for each place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.electrodes.blob_response import BlobResponse
from fluoromap.segmenter.electrodes.network.network_response import NetworkEvidence
from fluoromap.segmenter.electrodes.proposals import Likeness, Proposals, log_odds, probability_of_contrast
from fluoromap.segmenter.picture.log_image import Image

_EVEN_SHARE = 0.5
_LEAST_PROBABILITY = 0.05
_ENOUGH_CONTRAST = 8.0
_APART_MM = 0.6
_HALF_APART_MM, _HALF_SD_MM = 0.3, 0.25
_WIDEST_RING_MM, _AIMS_APART, _MIDDLE_MM = 2.0, 0.5, 0.4
"""Parts of one electrode: how far apart they are at most, and the cells' aims over that; how far off its middle a part may be."""
_FAINT, _CLEAR = 5.0, 9.5
FAINT_LOG_ODDS = 4.5
"""Of an electrode that is too faint for the network to be sure, where other frames confirm it."""


@dataclass(slots=True, eq=False)
class JointEvidence:
    """Network and blobs of one log image, see :class:`~fluoromap.segmenter.electrodes.proposals.ImageEvidence`.

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
        of_network, contrast = self._ask(blobs.points_uv)
        likely = self._scores(of_network, contrast) >= _LEAST_PROBABILITY
        points_uv, covariance_px2 = blobs.points_uv[likely], blobs.covariance_px2[likely]
        probability = _probability(_mean_odds(of_network, contrast)[likely])
        if self.reach_cells == 1:
            proposed = self.network.proposals(allowed, expected)
            away = np.ones(len(proposed), np.bool_)
            if len(points_uv) and len(proposed):
                difference = proposed.points_uv[:, None] - points_uv
                away = np.sqrt((difference * difference).sum(axis=2).min(axis=1)) > _APART_MM * self.px_per_mm
            points_uv = np.concatenate([points_uv, proposed.points_uv[away]])
            probability = np.concatenate([probability, proposed.probability[away]])
            covariance_px2 = np.concatenate([covariance_px2, proposed.covariance_px2[away]])
        order = np.argsort(-probability, kind="stable")
        return self._without_parts(Proposals(points_uv[order], probability[order], covariance_px2[order]))

    def _without_parts(self, proposed: Proposals) -> Proposals:
        """Return the proposals, of several parts of one electrode only one.

        The rims of a wide ring are blobs too. The cells there point to the ring's middle, those of two electrodes to both. The
        part nearest to the middle has the electrode's place, or the middle has it where all parts are away from it. The parts'
        scatter adds to the covariance.
        """
        count = len(proposed)
        aims = self.network.aims_at(proposed.points_uv) if count else np.zeros((0, 2))
        is_part = np.zeros(count, np.bool_)
        parts: dict[int, list[int]] = {}
        if count:
            pairs = cKDTree(proposed.points_uv).query_pairs(_WIDEST_RING_MM * self.px_per_mm, output_type="ndarray")
            away, aims_away = (
                np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
                for places in (proposed.points_uv, aims)
            )
            pairs = np.sort(pairs[aims_away < _AIMS_APART * away], axis=1)
            for first, second in pairs[np.lexsort(pairs.T[::-1])].tolist():
                if not is_part[first] and not is_part[second]:
                    is_part[second] = True
                    parts.setdefault(first, [first]).append(second)
        points, covariance = proposed.points_uv.copy(), proposed.covariance_px2.copy()
        for first, own in parts.items():
            middle = aims[own].mean(axis=0)
            off = np.linalg.norm(proposed.points_uv[own] - middle, axis=1)
            nearest = own[int(np.argmin(off))]
            points[first], covariance[first] = proposed.points_uv[nearest], proposed.covariance_px2[nearest]
            if off.min() > _MIDDLE_MM * self.px_per_mm:
                points[first] = middle
            scatter = proposed.points_uv[own] - points[first]
            covariance[first] += scatter.T @ scatter / len(own)
        return Proposals(points[~is_part], proposed.probability[~is_part], covariance[~is_part])

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

    def _ask(self, points_uv: Array) -> tuple[Array, Array]:
        """Return the network's log-odds of electrodes at points, and the contrast there, both (n,)."""
        return log_odds(self.network.probability_at(points_uv, self.reach_cells)), self.blobs.scores_at(points_uv)

    def probability_at(self, points_uv: Array) -> Array:
        """Return the probability of electrodes at points, (n,).

        Its log-odds are the mean of those of the network and twice those of the contrast.
        """
        return _probability(_mean_odds(*self._ask(points_uv)))

    def kind_odds_at(self, points_uv: Array) -> Array:
        """Return the log-odds by which electrodes differ from other blobs, (n,).

        They are those of :meth:`probability_at` with limited contrast: in a clear picture shafts and cables have as much contrast
        over noise as electrodes.
        """
        of_network, contrast = self._ask(points_uv)
        return _mean_odds(of_network, np.minimum(contrast, _ENOUGH_CONTRAST))

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
        return self._scores(*self._ask(points_uv))

    def _scores(self, of_network: Array, contrast: Array) -> Array:
        doubt = np.minimum(np.maximum((_CLEAR - contrast) / (_CLEAR - _FAINT), 0.0), 1.0)
        return _probability(of_network + self.faint_log_odds * doubt)


def _mean_odds(of_network: Array, contrast: Array) -> Array:
    odds: Array = _EVEN_SHARE * (of_network + 2.0 * log_odds(probability_of_contrast(contrast)))
    return odds


def _probability(log_odds_of_electrodes: Array) -> Array:
    probability: Array = 1.0 / (1.0 + np.exp(-log_odds_of_electrodes))
    return probability
