"""Which chain of one view is which chain of the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, Chain
from fluoromap.geometry import Camera
from fluoromap.matching.run_catheters import common_electrodes
from fluoromap.matching.two_view import signed_epipolar_px, triangulate_linear

COST_LIMIT_MM = 2.0
"""A pair that costs more (in pixels, over the pixels per mm at the isocentre) is not one."""
SHIFT_LIMIT_MM = 20.0
"""The heart is never farther from its place in the other run than this."""
_NEVER = 1e6
_SPACING_WEIGHT_PX_PER_MM = 3.0
_OFFSET_WEIGHT = 0.5
_COMMON_WEIGHT = 0.1


@dataclass(frozen=True, slots=True)
class Pair:
    """Chain ``a`` of one view and chain ``b`` of the other show the same catheter. cost_px : without the common offset."""

    a: int
    b: int
    cost_px: float


def spacing_misfit_mm(points_world_mm: Array, electrodes: Sequence[int], catheter: Catheter) -> float:
    """Mean difference between the distances of neighbouring electrodes and the catalogue's; 0 for a single electrode.

    points_world_mm : (m, 3) of the electrodes with these numbers, ascending.
    """
    if len(electrodes) < 2:
        return 0.0
    if electrodes[-1] > catheter.electrodes:
        return _NEVER
    along = np.diff(catheter.arc_lengths_mm[np.array(electrodes) - 1])
    found = np.linalg.norm(np.diff(points_world_mm, axis=0), axis=1)
    return float(np.abs(found - along).mean())


def common_points(camera_a: Camera, camera_b: Camera, first: Chain, second: Chain) -> tuple[tuple[int, ...], Array]:
    """Numbers of the electrodes that both chains hold, and their points (m, 3) in the world, mm."""
    i, j = common_electrodes(first, second)
    electrodes = tuple(first.electrodes[k] for k in i)
    if not electrodes:
        return (), np.zeros((0, 3))
    return electrodes, triangulate_linear(camera_a, camera_b, first.pixels_uv[i], second.pixels_uv[j])


def pair_chains(
    camera_a: Camera, camera_b: Camera, chains_a: Sequence[Chain], chains_b: Sequence[Chain], catalogue: Catalogue
) -> tuple[Pair, ...]:
    """Pair the chains of two views at least total cost.

    A pair costs ``mean|d - mean d| + 0.5 |mean d - o| + 3 x spacing misfit`` (pixels, mm), d the signed epipolar
    distance of each electrode. ``o`` is the offset that all catheters of the site share because the heart was breathed
    elsewhere, or the table stood elsewhere, when the second run was taken. It is searched for, up to 20 mm, and costs
    ``0.1 |o|`` once: a deep breath must not cost a site. Chains set by hand under different names are never paired.

    Returns
    -------
    tuple of Pair
        Pairs within the cost limit only.
    """
    if not chains_a or not chains_b:
        return ()
    own = np.full((len(chains_a), len(chains_b)), _NEVER)
    offsets = np.zeros_like(own)
    for i, first in enumerate(chains_a):
        for j, second in enumerate(chains_b):
            if first.manual and second.manual and first.kinds[:1] != second.kinds[:1]:
                continue
            in_a, in_b = common_electrodes(first, second)
            if not in_a:
                continue
            d = signed_epipolar_px(camera_a, camera_b, first.pixels_uv[in_a], second.pixels_uv[in_b])
            electrodes, points = common_points(camera_a, camera_b, first, second)
            misfit = min(spacing_misfit_mm(points, electrodes, catheter) for catheter in catalogue.catheters)
            offsets[i, j] = d.mean()
            own[i, j] = min(np.abs(d - d.mean()).mean() + _SPACING_WEIGHT_PX_PER_MM * misfit, _NEVER)
    scale = camera_b.px_per_mm
    limit = COST_LIMIT_MM * scale
    candidates = [0.0, *offsets[(own <= limit) & (np.abs(offsets) <= SHIFT_LIMIT_MM * scale)]]
    return min((_pairs_at(own, offsets, o, limit) for o in candidates), key=lambda answer: answer[0])[1]


def _pairs_at(own: Array, offsets: Array, common: float, limit: float) -> tuple[float, tuple[Pair, ...]]:
    """Total cost and pairs when every catheter is displaced by ``common`` pixels across the epipolar lines."""
    cost = np.minimum(own + _OFFSET_WEIGHT * np.abs(offsets - common), limit + 1.0)
    rows, columns = linear_sum_assignment(cost)
    kept = tuple(
        Pair(int(r), int(c), float(cost[r, c])) for r, c in zip(rows, columns, strict=True) if cost[r, c] <= limit
    )
    return float(cost[rows, columns].sum()) + _COMMON_WEIGHT * abs(common), kept
