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
from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.chains.families import CatheterFamily
from fluoromap.segmenter.chains.path_search import find_paths
from fluoromap.segmenter.chains.row_tracing import trace_rows
from fluoromap.segmenter.electrodes.proposals import answers_for_each
from fluoromap.segmenter.picture.field_mask import are_in
from fluoromap.segmenter.shape.curve import predict_on_curve
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

_LEAST_KNOWN = 3
_INNER_SD_MM, _END_SD_MM, _TRACED_SD_MM, _MERGED_SD_MM = 0.4, 0.7, 0.9, 0.5
_TRACED_LEAST, _TRACED_PRICE, _MERGED_EVIDENCE = -1.0, 1.0, -1.5
_MOST, _MOST_ROWS = 100, 40


@dataclass(frozen=True, slots=True, eq=False)
class CompletedChains:
    """Chains of candidates with predicted electrodes: one each, or a few of many.

    points_uv, weights, variance_px2 : the candidates, then the predicted electrodes.
    rows : for each family, the indices of its chains from the tip on, (n, electrodes).
    is_merged : which points are electrodes that another one covers, (all points,).
    """

    points_uv: Array
    weights: Array
    variance_px2: Array
    rows: tuple[IntArray, ...]
    is_merged: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _IncompleteChains:
    """Chains that lack the same electrodes.

    rows : indices of the candidates from the tip on, (n, electrodes - 1); of a long catheter one row (1, electrodes) with -1 for
    missing electrodes. missing : indices of the missing electrodes. places_uv : where they are predicted, (n, 2) or (missing, 2).
    merged : of a long catheter, (missing,) candidates of other electrodes that cover the missing ones, or -1.
    """

    rows: IntArray
    missing: IntArray
    places_uv: Array
    merged: IntArray


def complete_chains(
    points_uv: Array,
    weights: Array,
    variance_px2: Array,
    evidence_at: Callable[[Array], Array],
    least_evidence: float,
    families: Sequence[CatheterFamily],
    px_per_mm: float,
    inside: BoolArray,
) -> CompletedChains:
    """Complete all chains of candidates that lack electrodes.

    A chain may lack one electrode, or a few of many. The missing electrode is predicted on a smooth curve through the
    others.

    Parameters
    ----------
    points_uv, weights, variance_px2 : (n, 2), (n,), (n,)
        As in :func:`~fluoromap.segmenter.chains.linking.link_candidates`.
    evidence_at : callable
        (k, 2) pixels -> (k,) evidence.
    least_evidence : float
        A predicted electrode that has no more is dropped.
    families : sequence of CatheterFamily
    px_per_mm : float
        At the isocentre.
    inside : (rows, columns) bool
        The field. A long catheter may have more missing electrodes outside it.
    """
    points = np.ascontiguousarray(points_uv, dtype=np.float64)
    incomplete = [_incomplete_chains(points, weights, family.catheter, px_per_mm, inside) for family in families]
    predicted = [chains.places_uv for of_family in incomplete for chains in of_family]
    dark_of = iter(answers_for_each(evidence_at, predicted))
    places, gained, spread, merged = [points], [weights], [variance_px2], [np.zeros(len(points), np.bool_)]
    count = len(points)
    rows: list[IntArray] = []
    for family, of_family in zip(families, incomplete, strict=True):
        electrodes = family.catheter.electrodes
        complete = [np.zeros((0, electrodes), np.int64)]
        for chains in of_family:
            dark = next(dark_of)
            kept = np.arange(len(dark))
            if electrodes >= MANY_ELECTRODES:
                # The electrodes on both sides vouch for the place; what shows there may be another catheter.
                is_merged = chains.merged >= 0
                price = _TRACED_PRICE * are_in(inside, chains.places_uv)
                traced = np.clip(dark, _TRACED_LEAST, 0.0) - price
                dark = np.where(is_merged, _MERGED_EVIDENCE, traced)
                sd = np.where(is_merged, _MERGED_SD_MM, _TRACED_SD_MM)
                row = chains.rows.copy()
                row[0, chains.missing] = count + kept
                complete.append(row)
            else:
                value = dark + weights[chains.rows].sum(axis=1)
                kept = np.flatnonzero(dark > least_evidence)
                kept = kept[np.argsort(-value[kept], kind="stable")[:_MOST]]
                sd = np.full(len(kept), _END_SD_MM if chains.missing[0] in (0, electrodes - 1) else _INNER_SD_MM)
                complete.append(np.insert(chains.rows[kept], chains.missing[0], count + np.arange(len(kept)), axis=1))
            places.append(chains.places_uv[kept])
            gained.append(dark[kept])
            spread.append((sd * px_per_mm) ** 2)
            merged.append(np.broadcast_to(chains.merged >= 0, len(dark))[kept])
            count += len(kept)
        rows.append(np.concatenate(complete))
    return CompletedChains(
        np.concatenate(places), np.concatenate(gained), np.concatenate(spread), tuple(rows), np.concatenate(merged)
    )


def _incomplete_chains(
    points: Array, weights: Array, catheter: Catheter, px_per_mm: float, inside: BoolArray
) -> list[_IncompleteChains]:
    """Return the chains of candidates (n, 2) that lack electrodes of a catheter."""
    electrodes, found = catheter.electrodes, []
    if electrodes >= MANY_ELECTRODES:
        traced = trace_rows(points, weights, catheter, px_per_mm, _MOST_ROWS, inside)
        for row, position, merged in zip(*traced, strict=True):
            missing = np.flatnonzero(row < 0)
            found.append(_IncompleteChains(row[None], missing, position[missing], merged[missing]))
    elif electrodes > _LEAST_KNOWN and len(points) >= electrodes - 1:
        for number in range(electrodes):
            arc_mm = np.delete(catheter.arc_lengths_mm, number)
            paths = find_paths(points, weights, np.diff(arc_mm) * px_per_mm, px_per_mm)
            places_uv = _curve_weights(catheter, number) @ points[paths]
            found.append(_IncompleteChains(paths, np.array([number]), places_uv, np.array([-1])))
    return found


@functools.lru_cache(maxsize=256)
def _curve_weights(catheter: Catheter, missing: int) -> Array:
    """Return the weights of the other electrodes in the predicted position, (electrodes - 1,)."""
    is_missing = np.arange(catheter.electrodes) == missing
    others = np.insert(np.eye(catheter.electrodes - 1), missing, 0.0, axis=0)
    weights_of_others: Array = predict_on_curve(others, is_missing, catheter.arc_lengths_mm)[0]
    return weights_of_others
