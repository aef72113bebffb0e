"""What the network says about a few places of a log image: it looks at their surroundings only."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.electrodes.network.forward import Part
from fluoromap.segmenter.electrodes.network.layers import CELL_PX, STRIDE_PX
from fluoromap.segmenter.electrodes.network.network_response import (
    NetworkResponse,
    cell_grid,
    electrode_probability,
    highest_near,
    network_scale,
    padded,
)
from fluoromap.segmenter.electrodes.network.normalisation import normalise
from fluoromap.segmenter.electrodes.network.weights import Trained
from fluoromap.segmenter.electrodes.proposals import Proposals
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.picture.resampling import resampled

_FIELD_PX = 13 * STRIDE_PX
"""How far from a cell the farthest pixel lies that its answer depends on, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Probability of an electrode's centre in a rectangle of cells that begins at the cell (left, top)."""

    left: int
    top: int
    probability: Image

    def contains(self, left: int, top: int, right: int, bottom: int) -> bool:
        """Return whether the cells from (left, top) to before (right, bottom) are among these."""
        rows, columns = self.probability.shape
        return self.left <= left and self.top <= top and right <= self.left + columns and bottom <= self.top + rows


@dataclass(slots=True, eq=False)
class NearbyNetwork:
    """Answers of the network to one log image: near places that are asked about, or to all of it.

    The answers are those of :class:`~fluoromap.segmenter.electrodes.network.network_response.NetworkResponse` up to rounding.
    """

    x: Image
    trained: Trained
    px_per_mm: float
    _picture: Image | None = field(default=None, init=False)
    _near: _Cells | None = field(default=None, init=False)
    _whole: NetworkResponse | None = field(default=None, init=False)

    def whole(self) -> NetworkResponse:
        """Return the answers to the whole image."""
        if self._whole is None:
            self._whole = NetworkResponse.of_image(self.x, self.trained, self.px_per_mm)
        return self._whole

    def proposals(self, allowed: BoolArray, expected: int) -> Proposals:
        """Return the electrodes found where ``allowed``, most probable first."""
        return self.whole().proposals(allowed, expected)

    def halves_of_pairs(self) -> Array:
        """Return both electrodes of pairs that were found as one, (n, 2) pixels."""
        return self.whole().halves_of_pairs()

    def tip_logits_at(self, points_uv: Array, reach_cells: int = 1) -> Array:
        """Return the logits of tip electrodes at points, (n,)."""
        return self.whole().tip_logits_at(points_uv, reach_cells)

    def aims_at(self, points_uv: Array) -> Array:
        """Return the places to which the cells at points point, (n, 2) pixels."""
        return self.whole().aims_at(points_uv)

    def probability_at(self, points_uv: Array, reach_cells: int = 1) -> Array:
        """Return the highest probability of the cells within reach of each point, (n,)."""
        scale = network_scale(self.px_per_mm)
        cell_px, first_px = cell_grid(scale)
        if self._picture is None:
            self._picture = normalise(resampled(self.x, scale))
        middle = np.rint((points_uv - first_px) / cell_px).astype(np.int64)
        last = -(-np.array(self._picture.shape[::-1]) // CELL_PX) - 1
        left, top = np.clip(middle.min(axis=0) - reach_cells, 0, last).tolist()
        right, bottom = (np.clip(middle.max(axis=0) + reach_cells, 0, last) + 1).tolist()
        if self._near is None or not self._near.contains(left, top, right, bottom):
            self._near = _Cells(left, top, self._ask(self._picture, left, top, right, bottom))
        return highest_near(self._near.probability, middle - (self._near.left, self._near.top), reach_cells)

    def _ask(self, picture: Image, left: int, top: int, right: int, bottom: int) -> Image:
        """Ask the network about the cells from (left, top) to before (right, bottom)."""
        # Layers with steps start at the same pixels as in the whole picture.
        first_u, first_v = (max(cell * CELL_PX - _FIELD_PX, 0) // STRIDE_PX * STRIDE_PX for cell in (left, top))
        last_u, last_v = (cell * CELL_PX + _FIELD_PX for cell in (right, bottom))
        part = picture[first_v:last_v, first_u:last_u]
        u, v = left - first_u // CELL_PX, top - first_v // CELL_PX
        cells = Part(v, u, v + bottom - top, u + right - left)
        return electrode_probability(self.trained, self.trained.ensemble(padded(part), cells))
