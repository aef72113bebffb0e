"""Catheters of which one electrode has no blob of its own: a steeply foreshortened tip hides the ring behind it, or another
catheter crosses. The others tell where it has to be; the image has to be dark there."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, IntArray
from fluoromap.segmenter import chain_search
from fluoromap.segmenter.linking import Family
from fluoromap.segmenter.refinement import on_curve

_LEAST_SEEN = 3
_INNER_SD_MM, _END_SD_MM = 0.4, 0.7
_MOST = 100


@dataclass(frozen=True, slots=True, eq=False)
class Completed:
    """Chains of candidates with one predicted electrode each.

    points_uv, weights, variance_px2 : the candidates, then the predicted electrodes. rows : one (n, electrodes) array of
    their indices from the tip on for each family.
    """

    points_uv: Array
    weights: Array
    variance_px2: Array
    rows: tuple[IntArray, ...]


def complete(
    points_uv: Array,
    weights: Array,
    variance_px2: Array,
    evidence_at: Callable[[Array], Array],
    least_evidence: float,
    kinds: Sequence[Family],
    px_per_mm: float,
) -> Completed:
    """All chains of candidates that lack one electrode, which is put on a smooth curve through the others.

    Parameters
    ----------
    points_uv, weights, variance_px2 : (n, 2), (n,), (n,)
        As in :func:`~fluoromap.segmenter.linking.link`.
    evidence_at : callable
        (k, 2) pixels -> (k,) evidence.
    least_evidence : float
        A predicted electrode that has no more is dropped.
    kinds : sequence of Family
    px_per_mm : float
        At the isocentre.
    """
    points = np.ascontiguousarray(points_uv, dtype=np.float64)
    places, gained, spread = [points], [weights], [variance_px2]
    count = len(points)
    rows: list[IntArray] = []
    for family in kinds:
        electrodes = family.catheter.electrodes
        of_family = [np.zeros((0, electrodes), np.int64)]
        for lacking in range(electrodes) if electrodes > _LEAST_SEEN and len(points) >= electrodes - 1 else ():
            seen = np.delete(family.catheter.arc_lengths_mm, lacking)
            paths = chain_search.paths(points, weights, np.diff(seen) * px_per_mm)
            predicted = _shares(family.catheter, lacking) @ points[paths]
            dark = evidence_at(predicted)
            kept = np.flatnonzero(dark > least_evidence)
            kept = kept[np.argsort(-(dark[kept] + weights[paths[kept]].sum(axis=1)), kind="stable")[:_MOST]]
            numbers = count + np.arange(len(kept))
            of_family.append(np.insert(paths[kept], lacking, numbers, axis=1))
            places.append(predicted[kept])
            gained.append(dark[kept])
            sd = _END_SD_MM if lacking in (0, electrodes - 1) else _INNER_SD_MM
            spread.append(np.full(len(kept), (sd * px_per_mm) ** 2))
            count += len(kept)
        rows.append(np.concatenate(of_family))
    return Completed(np.concatenate(places), np.concatenate(gained), np.concatenate(spread), tuple(rows))


@functools.lru_cache(maxsize=256)
def _shares(catheter: Catheter, lacking: int) -> Array:
    """What each of the other electrodes adds to the place of the lacking one, (electrodes - 1,)."""
    covered = np.arange(catheter.electrodes) == lacking
    others = np.insert(np.eye(catheter.electrodes - 1), lacking, 0.0, axis=0)
    shares: Array = on_curve(others, covered, catheter.arc_lengths_mm)[0]
    return shares
