"""Catheters with one electrode that has no blob of its own.

A steeply foreshortened tip hides the ring behind it, or another catheter crosses. The other electrodes predict the missing
one; the image must allow it there.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, IntArray
from fluoromap.segmenter import chain_search
from fluoromap.segmenter.linking import CatheterFamily
from fluoromap.segmenter.long_catheters import MANY_ELECTRODES, trace_rows
from fluoromap.segmenter.refinement import predict_on_curve

_LEAST_KNOWN = 3
_INNER_SD_MM, _END_SD_MM, _TRACED_SD_MM = 0.4, 0.7, 0.9
_TRACED_LEAST = -1.0
_MOST = 100


@dataclass(frozen=True, slots=True, eq=False)
class CompletedChains:
    """Chains of candidates with one predicted electrode each.

    points_uv, weights, variance_px2 : the candidates, then the predicted electrodes.
    rows : for each family, the indices of its chains from the tip on, (n, electrodes).
    """

    points_uv: Array
    weights: Array
    variance_px2: Array
    rows: tuple[IntArray, ...]


def complete_chains(
    points_uv: Array,
    weights: Array,
    variance_px2: Array,
    evidence_at: Callable[[Array], Array],
    least_evidence: float,
    families: Sequence[CatheterFamily],
    px_per_mm: float,
) -> CompletedChains:
    """Complete all chains of candidates that lack electrodes.

    A chain may lack one electrode, or a few of many. The missing electrode is predicted on a smooth curve through the
    others.

    Parameters
    ----------
    points_uv, weights, variance_px2 : (n, 2), (n,), (n,)
        As in :func:`~fluoromap.segmenter.linking.link_candidates`.
    evidence_at : callable
        (k, 2) pixels -> (k,) evidence.
    least_evidence : float
        A predicted electrode that has no more is dropped.
    families : sequence of CatheterFamily
    px_per_mm : float
        At the isocentre.
    """
    points = np.ascontiguousarray(points_uv, dtype=np.float64)
    places, gained, spread = [points], [weights], [variance_px2]
    count = len(points)
    rows: list[IntArray] = []
    for family in families:
        electrodes = family.catheter.electrodes
        of_family = [np.zeros((0, electrodes), np.int64)]
        if electrodes >= MANY_ELECTRODES:
            traced, positions = trace_rows(points, weights, np.asarray(family.catheter.spacing_mm) * px_per_mm, _MOST)
            for row, position in zip(traced, positions, strict=True):
                lacking = np.flatnonzero(row < 0)
                # The electrodes on both sides vouch for the place; what shows there may be another catheter.
                dark = np.clip(evidence_at(position[lacking]), _TRACED_LEAST, 0.0) if len(lacking) else np.zeros(0)
                numbered = row.copy()
                numbered[lacking] = count + np.arange(len(lacking))
                of_family.append(numbered[None])
                places.append(position[lacking])
                gained.append(dark)
                spread.append(np.full(len(lacking), (_TRACED_SD_MM * px_per_mm) ** 2))
                count += len(lacking)
            rows.append(np.concatenate(of_family))
            continue
        for missing in range(electrodes) if electrodes > _LEAST_KNOWN and len(points) >= electrodes - 1 else ():
            arc_mm = np.delete(family.catheter.arc_lengths_mm, missing)
            paths = chain_search.find_paths(points, weights, np.diff(arc_mm) * px_per_mm)
            predicted = _curve_weights(family.catheter, missing) @ points[paths]
            dark = evidence_at(predicted)
            kept = np.flatnonzero(dark > least_evidence)
            kept = kept[np.argsort(-(dark[kept] + weights[paths[kept]].sum(axis=1)), kind="stable")[:_MOST]]
            numbers = count + np.arange(len(kept))
            of_family.append(np.insert(paths[kept], missing, numbers, axis=1))
            places.append(predicted[kept])
            gained.append(dark[kept])
            sd = _END_SD_MM if missing in (0, electrodes - 1) else _INNER_SD_MM
            spread.append(np.full(len(kept), (sd * px_per_mm) ** 2))
            count += len(kept)
        rows.append(np.concatenate(of_family))
    return CompletedChains(np.concatenate(places), np.concatenate(gained), np.concatenate(spread), tuple(rows))


@functools.lru_cache(maxsize=256)
def _curve_weights(catheter: Catheter, missing: int) -> Array:
    """Return the weights of the other electrodes in the predicted position, (electrodes - 1,)."""
    is_missing = np.arange(catheter.electrodes) == missing
    others = np.insert(np.eye(catheter.electrodes - 1), missing, 0.0, axis=0)
    weights_of_others: Array = predict_on_curve(others, is_missing, catheter.arc_lengths_mm)[0]
    return weights_of_others
