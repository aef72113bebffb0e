"""What the network says about one log image: electrodes proposed, and their probability anywhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.electrodes.network.layers import CELL_PX, HEADS, STRIDE_PX
from fluoromap.segmenter.electrodes.network.normalisation import normalise
from fluoromap.segmenter.electrodes.network.orientations import mean_answer
from fluoromap.segmenter.electrodes.network.weights import Trained
from fluoromap.segmenter.electrodes.proposals import Proposals
from fluoromap.segmenter.picture.gaussian_blur import repeat_edge
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.picture.resampling import resampled

NETWORK_PX_PER_MM = 3.0
"""The scale at which the networks know most electrodes.

They are trained on 2.3 to 4.6 px/mm, mostly on thin catheters. In a smaller picture a wide ablation catheter
looks like those.
"""

_TAKEN_AS_IS = 0.85, 1.1
_LEAST_PROBABILITY = 0.03
_APART_CELLS = 1.2
_FLOOR_CELLS = 0.4
_MOST = 120
_MOST_OFFSET_CELLS = 1.5
_PAIR_PROBABILITY, _AIMING_PROBABILITY = 0.3, 0.15
_PAIR_REACH_CELLS = 2
_PAIR_EXTENT_CELLS = 0.4
_PAIR_HALF_CELLS = 0.7, 0.35
"""Half the distance of a pair in cells, and how it grows with the extent of the places that cells point to.

Of simulated pairs 1.5 to 3 cells apart, the extents were 0.2 to 0.4 below 2 cells and about 1 below 2.5.
"""
_HEAT, _OFFSET_U, _OFFSET_V, _LOG_VARIANCE, _TIP = (
    HEADS.index(name) for name in ("heat", "offset_u", "offset_v", "log_variance", "tip")
)


class NetworkEvidence(Protocol):
    """What the network says about one log image; see :class:`NetworkResponse`."""

    def proposals(self, allowed: BoolArray, expected: int) -> Proposals: ...

    def halves_of_pairs(self) -> Array: ...

    def tip_logits_at(self, points_uv: Array, reach_cells: int = 1) -> Array: ...

    def probability_at(self, points_uv: Array, reach_cells: int = 1) -> Array: ...

    def aims_at(self, points_uv: Array) -> Array: ...


@dataclass(frozen=True, slots=True, eq=False)
class NetworkResponse:
    """Answers of the network to one log image.

    probability : (rows, columns) float32 of an electrode's centre in each cell. answers : (rows, columns, heads) float32.
    found : electrodes in the whole image. cell_px, first_px : frame pixels from cell to cell, and where the first lies.
    variance_gain : see :class:`~fluoromap.segmenter.electrodes.network.weights.Trained`.
    """

    probability: Image
    answers: Image
    found: Proposals
    cell_px: float
    first_px: float
    variance_gain: float

    @property
    def nbytes(self) -> int:
        """Memory of the answers, bytes."""
        return self.answers.nbytes + self.probability.nbytes

    @classmethod
    def of_image(cls, x: Image, trained: Trained, px_per_mm: float, orientations: int = 1) -> NetworkResponse:
        """Ask the network about a log image, reduced to the network's scale.

        ``orientations`` : see :func:`~fluoromap.segmenter.electrodes.network.orientations.mean_answer`.
        """
        scale = network_scale(px_per_mm)
        return cls.of_reduced(resampled(x, scale), trained, scale, orientations)

    @classmethod
    def of_reduced(cls, small: Image, trained: Trained, scale: float, orientations: int = 1) -> NetworkResponse:
        """Ask the network about a reduced log image.

        It has ``scale`` times the size of the frame. ``orientations`` : see
        :func:`~fluoromap.segmenter.electrodes.network.orientations.mean_answer`.
        """
        answers = answer(trained, normalise(small), orientations)
        probability = electrode_probability(trained, answers)
        cell_px, first_px = cell_grid(scale)
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

    def halves_of_pairs(self) -> Array:
        """Return both electrodes of pairs that were found as one.

        The result has the shape (n, 2), pixels. Each cell near an electrode points to the electrode nearest to it. Cells that
        point to different places see two electrodes that lie too close together for a peak each.
        """
        likely = self.found.points_uv[self.found.probability >= _PAIR_PROBABILITY]
        if not len(likely):
            return np.zeros((0, 2))
        peaks = (likely - self.first_px) / self.cell_px
        rows, columns = self.probability.shape
        steps = np.arange(-_PAIR_REACH_CELLS, _PAIR_REACH_CELLS + 1)
        v = np.clip(np.rint(peaks[:, 1]).astype(np.int64)[:, None, None] + steps[:, None], 0, rows - 1)
        u = np.clip(np.rint(peaks[:, 0]).astype(np.int64)[:, None, None] + steps, 0, columns - 1)
        size = len(steps) ** 2
        v, u = (
            np.broadcast_to(cells, (len(peaks), len(steps), len(steps))).reshape(len(peaks), size) for cells in (v, u)
        )
        weights = self.probability[v, u].astype(np.float64)
        aims = np.stack([u + self.answers[v, u, _OFFSET_U], v + self.answers[v, u, _OFFSET_V]], axis=-1).astype(
            np.float64
        )
        _, nearest = cKDTree(peaks).query(aims)
        weights[(weights < _AIMING_PROBABILITY) | (nearest != np.arange(len(peaks))[:, None])] = 0.0
        total = np.maximum(weights.sum(axis=1), 1e-9)
        middle = (weights[..., None] * aims).sum(axis=1) / total[:, None]
        away = aims - middle[:, None]
        spread = np.einsum("nk,nki,nkj->nij", weights, away, away) / total[:, None, None]
        _, axes = np.linalg.eigh(spread)
        axis = axes[:, :, 1]
        along = np.where(weights > 0, np.einsum("nki,ni->nk", away, axis), 0.0)
        extent = np.ptp(along, axis=1)
        half = (_PAIR_HALF_CELLS[0] + _PAIR_HALF_CELLS[1] * extent)[:, None] * axis
        split = extent >= _PAIR_EXTENT_CELLS
        halves = np.concatenate([(middle - half)[split], (middle + half)[split]])
        return halves * self.cell_px + self.first_px

    def tip_logits_at(self, points_uv: Array, reach_cells: int = 1) -> Array:
        """Return the logits of tip electrodes at points, (n,).

        The most probable cell within reach of a point answers.
        """
        v, u = self._cells_near(points_uv, reach_cells)
        best = np.argmax(self.probability[v, u].reshape(len(points_uv), -1), axis=1)
        logits = self.answers[v, u, _TIP].reshape(len(points_uv), -1)
        said: Array = logits[np.arange(len(points_uv)), best].astype(np.float64)
        return said

    def probability_at(self, points_uv: Array, reach_cells: int = 1) -> Array:
        """Return the highest probability of the cells within reach of each point, (n,)."""
        middle = np.rint((points_uv - self.first_px) / self.cell_px).astype(np.int64)
        return highest_near(self.probability, middle, reach_cells)

    def shares_at(self, chain_uv: Array) -> Array:
        """Return the highest probability of the cells within reach of each electrode of a chain, (n,).

        Each cell speaks for one electrode only, the nearest: two electrodes cannot be proved by one dark place.
        """
        v, u = self._cells_near(chain_uv, 1)
        cells = np.stack(np.broadcast_arrays(u, v), axis=-1)
        away = np.linalg.norm(cells[:, :, :, None] - (chain_uv - self.first_px) / self.cell_px, axis=-1)
        own = away.argmin(axis=-1) == np.arange(len(chain_uv))[:, None, None]
        shares: Array = np.where(own, self.probability[v, u], 0.0).max(axis=(1, 2)).astype(np.float64)
        return shares

    def aims_at(self, points_uv: Array) -> Array:
        """Return the places to which the cells at points point, (n, 2) pixels.

        Each cell points to the electrode nearest to it.
        """
        v, u = self._cells_near(points_uv, 0)
        u, v = u[:, 0, 0], v[:, 0, 0]
        offsets = np.clip(
            self.answers[v, u][:, [_OFFSET_U, _OFFSET_V]].astype(np.float64), -_MOST_OFFSET_CELLS, _MOST_OFFSET_CELLS
        )
        aims: Array = (np.stack([u, v], axis=1) + offsets) * self.cell_px + self.first_px
        return aims

    def _cells_near(self, points_uv: Array, reach_cells: int) -> tuple[IntArray, IntArray]:
        """Return rows and columns of the cells near points.

        Both broadcast to (n, 2 reach + 1, 2 reach + 1).
        """
        rows, columns = self.probability.shape
        middle = np.rint((points_uv - self.first_px) / self.cell_px).astype(np.int64)
        steps = np.arange(-reach_cells, reach_cells + 1)
        v = np.minimum(np.maximum(middle[:, 1, None, None] + steps[:, None], 0), rows - 1)
        u = np.minimum(np.maximum(middle[:, 0, None, None] + steps, 0), columns - 1)
        return v, u


def cell_grid(scale: float) -> tuple[float, float]:
    """Return the distance of cells and the first cell's place.

    Both are in pixels of the frame. ``scale`` : see :func:`network_scale`.
    """
    return CELL_PX / scale, 0.5 / scale - 0.5


def electrode_probability(trained: Trained, answers: Image) -> Image:
    """Return the probability of an electrode's centre in each cell by the answers (rows, columns, heads)."""
    odds = trained.odds_gain * answers[..., _HEAT] + trained.odds_offset
    probability: Image = 1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0)))
    return probability


def highest_near(probability: Image, cells: IntArray, reach: int) -> Array:
    """Return the highest probability of the cells within reach of each of the cells (n, 2), (n,)."""
    near, (rows, columns) = np.arange(-reach, reach + 1), probability.shape
    u, v = np.clip(cells[:, 0, None] + near, 0, columns - 1), np.clip(cells[:, 1, None] + near, 0, rows - 1)
    highest: Array = probability[v[:, :, None], u[:, None, :]].max(axis=(1, 2))
    return highest


def _peaks(probability: Image, answers: Image, cell_px: float, first_px: float, variance_gain: float) -> Proposals:
    """Return the cells that no neighbour exceeds, most probable first.

    Each has 0.03 or more and is 1.2 cells from all better ones.
    """
    v, u = np.nonzero(probability >= _LEAST_PROBABILITY)
    highest = probability[v, u] >= highest_near(probability, np.stack([u, v], axis=1), 1)
    v, u = v[highest], u[highest]
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


def answer(trained: Trained, picture: Image, orientations: int = 1) -> Image:
    """Return the network's answers to a normalised picture of any size, (rows / 2, columns / 2, heads), both rounded up.

    ``orientations`` : see :func:`~fluoromap.segmenter.electrodes.network.orientations.mean_answer`.
    """
    rows, columns = picture.shape
    answers = mean_answer(trained.ensemble, padded(picture), orientations)
    return answers[: -(-rows // CELL_PX), : -(-columns // CELL_PX)]


def padded(picture: Image) -> Image:
    """Return a picture whose size the layers with steps divide.

    Its last row and column are repeated.
    """
    rows, columns = picture.shape
    return repeat_edge(picture, rows + -rows % STRIDE_PX, columns + -columns % STRIDE_PX)


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
