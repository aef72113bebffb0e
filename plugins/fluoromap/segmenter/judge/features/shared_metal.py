"""Chains that lie on the metal of another catheter: a wide electrode or a long tip may be proposed several times."""

from __future__ import annotations

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, Chain

_ON_METAL_MM, _HALF = 1.2, 0.5
_TINY = 1e-9


def lies_on_metal(chain: Chain, catheter: Catheter, other: Chain, of_other: Catheter, px_per_mm: float) -> bool:
    """Return whether half of a chain's electrodes lie on the metal of another chain.

    Of two chains that lie on each other this is true for the less probable one.

    Parameters
    ----------
    chain, other : Chain
        Two chains of one image.
    catheter, of_other : Catheter
        Theirs.
    px_per_mm : float
    """
    if _share_on(chain, other, of_other, px_per_mm) < _HALF:
        return False
    on_each_other = _share_on(other, chain, catheter, px_per_mm) >= _HALF
    return not on_each_other or bool(chain.scores.sum() < other.scores.sum())


def _share_on(chain: Chain, other: Chain, catheter: Catheter, px_per_mm: float) -> float:
    """Return the share of a chain's electrodes that lie on the metal of another chain.

    catheter : that of the other chain.
    """
    way = other.pixels_uv[0] - other.pixels_uv[min(1, len(other.pixels_uv) - 1)]
    half_tip = 0.5 * px_per_mm * catheter.tip_mm * way / max(float(np.linalg.norm(way)), _TINY)
    from_tip = chain.pixels_uv - other.pixels_uv[0]
    along = np.clip(from_tip @ half_tip / max(float(half_tip @ half_tip), _TINY), -1.0, 1.0)
    from_tip = from_tip - along[:, None] * half_tip
    from_rings = chain.pixels_uv[:, None] - other.pixels_uv[1:]
    nearest: Array = np.concatenate([from_tip[:, None], from_rings], axis=1)
    return float(np.mean(np.linalg.norm(nearest, axis=2).min(axis=1) <= _ON_METAL_MM * px_per_mm))
