"""What the network says about one log image: electrodes proposed, and their probability anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.learned_chain.layers import CELL_PX, HEADS, STRIDE_PX
from fluoromap.segmenter.learned_chain.normalisation import normalise
from fluoromap.segmenter.learned_chain.resampling import resampled
from fluoromap.segmenter.learned_chain.weights import Trained
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.proposals import Proposals

NETWORK_PX_PER_MM = 3.2
"""The scale in the middle of those the network is trained on."""

_TAKEN_AS_IS = 0.8, 1.2
_LEAST_PROBABILITY = 0.03
_APART_CELLS = 1.2
_FLOOR_CELLS = 0.4
_MOST = 120
_MOST_OFFSET_CELLS = 1.5
_HEAT, _OFFSET_U, _OFFSET_V, _LOG_VARIANCE = (
    HEADS.index(name) for name in ("heat", "offset_u", "offset_v", "log_variance")
)


@dataclass(frozen=True, slots=True, eq=False)
class NetworkResponse:
    """Answers of the network to one log image.

    probability : (rows, columns) float32 of an electrode's centre in each cell. answers : (rows, columns, heads) float32.
    found : electrodes in the whole image. cell_px, first_px : frame pixels from cell to cell, and where the first lies.
    variance_gain : see :class:`~fluoromap.segmenter.learned_chain.weights.Trained`.
    """

    probability: Image
    answers: Image
    found: Proposals
    cell_px: float
    first_px: float
    variance_gain: float

    @classmethod
    def of_image(cls, x: Image, trained: Trained, px_per_mm: float) -> NetworkResponse:
        """Ask the network about a log image, reduced to the network's scale."""
        scale = network_scale(px_per_mm)
        return cls.of_reduced(resampled(x, scale), trained, scale)

    @classmethod
    def of_reduced(cls, small: Image, trained: Trained, scale: float) -> NetworkResponse:
        """Ask the network about a reduced log image.

        It has ``scale`` times the size of the frame.
        """
        answers = answer(trained, normalise(small))
        odds = trained.odds_gain * answers[..., _HEAT] + trained.odds_offset
        probability = 1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0)))
        cell_px, first_px = CELL_PX / scale, 0.5 / scale - 0.5
        found = _peaks(probability, answers, cell_px, first_px, trained.variance_gain)
        return cls(probability, answers, found, cell_px, first_px, trained.variance_gain)

    def proposals(self, allowed: BoolArray, expected: int) -> Proposals:
        """Return the electrodes found where ``allowed``, most probable first."""
        rows, columns = allowed.shape
        column, row = np.rint(self.found.points_uv).astype(np.int64).T
        within = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        within &= allowed[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        kept = np.flatnonzero(within)[:_MOST]
        return Proposals(self.found.points_uv[kept], self.found.probability[kept], self.found.covariance_px2[kept])

    def probability_at(self, points_uv: Array, reach_cells: int = 1) -> Array:
        """Return the highest probability of the cells within reach of each point, (n,)."""
        rows, columns = self.probability.shape
        middle = np.rint((points_uv - self.first_px) / self.cell_px).astype(np.int64)
        steps = np.arange(-reach_cells, reach_cells + 1)
        v = np.clip(middle[:, 1, None, None] + steps[:, None], 0, rows - 1)
        u = np.clip(middle[:, 0, None, None] + steps, 0, columns - 1)
        highest: Array = self.probability[v, u].max(axis=(1, 2), initial=0.0).astype(np.float64)
        return highest


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
