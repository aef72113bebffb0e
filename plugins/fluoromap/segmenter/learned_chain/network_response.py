"""What the network says about one log image: electrodes proposed, and their probability anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.gaussian_blur import gaussian, reduce_by
from fluoromap.segmenter.learned_chain.layers import CELL_PX, HEADS, STRIDE_PX
from fluoromap.segmenter.learned_chain.normalisation import normalise
from fluoromap.segmenter.learned_chain.resampling import resampled
from fluoromap.segmenter.learned_chain.weights import Trained
from fluoromap.segmenter.log_image import Image, pixel_noise
from fluoromap.segmenter.proposals import Likeness, Proposals

NETWORK_PX_PER_MM = 3.2
"""The scale in the middle of those the network is trained on."""

_TAKEN_AS_IS = 0.8, 1.2
_LEAST_PROBABILITY = 0.03
_APART_CELLS = 1.2
_OWN_CELLS = 2.0
_FLOOR_CELLS = 0.4
_MOST = 120
_SMOOTH_MM = 0.52
_CLEAR_LIKENESS = 12.0
_MOST_OFFSET_CELLS = 1.5
_HEAT, _OFFSET_U, _OFFSET_V, _LOG_VARIANCE = (
    HEADS.index(name) for name in ("heat", "offset_u", "offset_v", "log_variance")
)


@dataclass(frozen=True, slots=True, eq=False)
class NetworkResponse:
    """Answers of the network to one log image.

    probability : (rows, columns) float32 of an electrode's centre in each cell. answers : (rows, columns, heads) float32.
    found : electrodes in the whole image. cell_px, first_px : frame pixels from cell to cell, and where the first lies.
    variance_gain : see
    :class:`~fluoromap.segmenter.learned_chain.weights.Trained`. smooth, reduction, pixel_noise : see
    :class:`~fluoromap.segmenter.proposals.ImageEvidence`.
    """

    probability: Image
    answers: Image
    found: Proposals
    cell_px: float
    first_px: float
    variance_gain: float
    smooth: Image
    reduction: int
    pixel_noise: float

    @classmethod
    def of_image(
        cls, x: Image, inside: BoolArray, trained: Trained, px_per_mm: float, least_noise: float
    ) -> NetworkResponse:
        """Ask the network about a log image, reduced to the network's scale."""
        scale = network_scale(px_per_mm)
        picture = normalise(resampled(x, scale))
        answers = answer(trained, picture)
        odds = trained.odds_gain * answers[..., _HEAT] + trained.odds_offset
        probability = 1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0)))
        reduction = 2 if min(x.shape) >= 64 else 1
        small = reduce_by(x, reduction) if reduction > 1 else x
        smooth = gaussian(small, max(_SMOOTH_MM * px_per_mm / reduction, 0.7))
        noise = pixel_noise(small, inside[::reduction, ::reduction])
        cell_px, first_px = CELL_PX / scale, 0.5 / scale - 0.5
        found = _peaks(probability, answers, cell_px, first_px, trained.variance_gain)
        return cls(
            probability,
            answers,
            found,
            cell_px,
            first_px,
            trained.variance_gain,
            smooth,
            reduction,
            max(noise, least_noise),
        )

    @property
    def likeness(self) -> Likeness:
        """The probability of an electrode in a cell or beside it, 12 where it is sure."""
        return Likeness(np.float32(_CLEAR_LIKENESS) * _highest_near(self.probability), self.cell_px, self.first_px)

    def proposals(self, allowed: BoolArray, expected: int) -> Proposals:
        """Return the electrodes found where ``allowed``, most probable first."""
        rows, columns = allowed.shape
        column, row = np.rint(self.found.points_uv).astype(np.int64).T
        within = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        within &= allowed[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        kept = np.flatnonzero(within)[:_MOST]
        return Proposals(self.found.points_uv[kept], self.found.probability[kept], self.found.covariance_px2[kept])

    def probability_at(self, points_uv: Array) -> Array:
        """Return the highest probability of the cell of each point and its eight neighbours, (n,)."""
        v, u = self._best_cells(points_uv)
        near: Array = self.probability[v, u].astype(np.float64)
        return near

    def unseen_probability_at(self, points_uv: Array) -> Array:
        """Return the same, but 0 within two cells of an electrode that was found."""
        probability = self.probability_at(points_uv)
        if len(self.found) and len(points_uv):
            away, _ = cKDTree(self.found.points_uv).query(points_uv)
            probability[away < _OWN_CELLS * self.cell_px] = 0.0
        return probability

    def scores_at(self, points_uv: Array) -> Array:
        """Return the probability of the electrode nearest to each point, (n,).

        Each electrode counts for one point only. Points without one have the probability of their own cell.
        """
        rows, columns = self.probability.shape
        u, v = np.rint((points_uv - self.first_px) / self.cell_px).astype(np.int64).T
        scores: Array = self.probability[np.clip(v, 0, rows - 1), np.clip(u, 0, columns - 1)].astype(np.float64)
        if not len(self.found):
            return scores
        away = np.linalg.norm(points_uv[:, None] - self.found.points_uv[None], axis=2)
        near = np.flatnonzero(away.min(axis=0) < _OWN_CELLS * self.cell_px)
        points, found = linear_sum_assignment(np.minimum(away[:, near], _OWN_CELLS * self.cell_px))
        matched = away[points, near[found]] < _OWN_CELLS * self.cell_px
        taken = np.zeros(len(scores), np.bool_)
        taken[points[matched]] = True
        shared = ~taken & (away[:, near].min(axis=1, initial=np.inf) < _OWN_CELLS * self.cell_px)
        scores[shared] = 0.0
        scores[points[matched]] = self.found.probability[near[found[matched]]]
        return scores

    def variance_at(self, points_uv: Array) -> Array:
        """Return the variance of electrodes' places at points, (n,) pixels squared."""
        v, u = self._best_cells(points_uv)
        return _variance_px2(self.answers[v, u, _LOG_VARIANCE].astype(np.float64), self.variance_gain, self.cell_px)

    def _best_cells(self, points_uv: Array) -> tuple[Array, Array]:
        rows, columns = self.probability.shape
        middle = np.rint((points_uv - self.first_px) / self.cell_px).astype(np.int64)
        steps = np.arange(-1, 2)
        v = np.clip(middle[:, 1, None, None] + steps[:, None], 0, rows - 1) + np.zeros(3, np.int64)
        u = np.clip(middle[:, 0, None, None] + steps, 0, columns - 1) + np.zeros((3, 1), np.int64)
        best = self.probability[v, u].reshape(len(middle), 9).argmax(axis=1)
        one = np.arange(len(middle))
        return v.reshape(-1, 9)[one, best], u.reshape(-1, 9)[one, best]


def _peaks(probability: Image, answers: Image, cell_px: float, first_px: float, variance_gain: float) -> Proposals:
    """Return the cells that no neighbour exceeds, most probable first.

    Each has 0.03 or more and is 1.2 cells from all better ones.
    """
    v, u = np.nonzero((probability >= _LEAST_PROBABILITY) & (probability >= _highest_near(probability)))
    best = np.argsort(-probability[v, u], kind="stable")[: 2 * _MOST]
    v, u = v[best], u[best]
    said = answers[v, u].astype(np.float64)
    offsets = np.clip(said[:, [_OFFSET_U, _OFFSET_V]], -_MOST_OFFSET_CELLS, _MOST_OFFSET_CELLS)
    cells = np.stack([u, v], axis=1) + offsets
    kept = np.flatnonzero(_apart(cells))
    variance = _variance_px2(said[kept, _LOG_VARIANCE], variance_gain, cell_px)
    return Proposals(
        cells[kept] * cell_px + first_px,
        probability[v, u][kept].astype(np.float64),
        variance[:, None, None] * np.eye(2),
    )


def _variance_px2(log_variance: Array, gain: float, cell_px: float) -> Array:
    """Add a floor to the variance that the network states.

    The rules that it learned from do not draw real electrodes.
    """
    variance: Array = (gain * np.exp(np.clip(log_variance, -8.0, 4.0)) + _FLOOR_CELLS**2) * cell_px**2
    return variance


def network_scale(px_per_mm: float) -> float:
    """Return how much the network's input is reduced or enlarged.

    A frame near the network's own scale stays unchanged.
    """
    scale = NETWORK_PX_PER_MM / px_per_mm
    return 1.0 if _TAKEN_AS_IS[0] <= scale <= _TAKEN_AS_IS[1] else scale


def answer(trained: Trained, picture: Image) -> Image:
    """Return the network's answers to a normalised picture of any size, (rows / 2, columns / 2, heads), both rounded up."""
    rows, columns = picture.shape
    padded = np.pad(picture, ((0, -rows % STRIDE_PX), (0, -columns % STRIDE_PX)), mode="edge")
    return trained.network(padded)[: -(-rows // CELL_PX), : -(-columns // CELL_PX)]


def _highest_near(values: Image) -> Image:
    """Return the highest of each value and its eight neighbours."""
    wide = np.pad(values, 1, constant_values=-np.inf)
    across = np.maximum(np.maximum(wide[:, :-2], wide[:, 1:-1]), wide[:, 2:])
    highest: Image = np.maximum(np.maximum(across[:-2], across[1:-1]), across[2:])
    return highest


def _apart(cells: Array) -> BoolArray:
    """Return which cells lie apart from all better ones, (n,).

    The best come first. A cell is kept when it is 1.2 cells or more from all that were kept before.
    """
    keep = np.ones(len(cells), np.bool_)
    if len(cells) > 1:
        pairs = cKDTree(cells).query_pairs(_APART_CELLS, output_type="ndarray")
        for first, second in pairs[np.argsort(pairs[:, 0], kind="stable")].tolist():
            keep[second] &= not keep[first]
    return keep
