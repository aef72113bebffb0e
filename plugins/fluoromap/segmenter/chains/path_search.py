"""Search for paths through candidates, and for their best set.

The kernels here and in :mod:`~fluoromap.segmenter.chains.path_scores` are written for a short compile time: they call no
kernel, sort nothing and assign no whole rows or arrays. Each of these would add seconds to the first start of a worker.
"""

from __future__ import annotations

import math

import numpy as np

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.shape.limits import LONGEST, MANY_ELECTRODES, SHORTEST
from fluoromap.segmenter.shape.loops import off_ellipse

_END_SLACK, _RING_MM = (0.55, 1.1), 0.7
"""Of a single gap: shares of the limits, and how much longer makers' rings may make it than the catalogue's rings do."""
_SPREAD, _SPREAD_A_GAP, _MOST_SPREAD = 0.6, 0.06, 0.9
"""How far the ratios of two gaps may differ: of neighbours, more for each gap between, at most. Long catheters turn in depth."""
_LEAST_COSINE, _MOST_TURNED = 0.55, 0.6
_MOST_CURVED_PER_MM, _MOST_BENT, _WIDE_GAPS_MM = 0.25, 1.6, 5.0
"""A long catheter is recognised by its many spacings, so that it may bend as far as its material does, radians."""
_INTERLEAVED, _IN_LINE = 2, 0.55
"""Chains can take turns only where the catalogue has a long catheter."""
_OFF_ELLIPSE = 0.2
"""Standard deviation of a place from an ellipse, in spacings."""
_PARTIAL = 1500
_GROWN = 60000
_MOST_TRIES = 300000


def find_paths(
    points: Array, weights: Array, spacing_px: Array, px_per_mm: float, angles_rad: Array | None = None
) -> IntArray:
    """Return all paths with spacings and bends that a catheter can show.

    Of each length the search continues with the 1500 paths of the largest weight. On a loop, places off the best ellipse lessen it.

    Parameters
    ----------
    points : (n, 2)
        Candidates, pixels.
    weights : (n,)
        Their :func:`~fluoromap.segmenter.chains.linking.evidence`.
    spacing_px : (electrodes - 1,)
        Spacings from the tip on, at the isocentre, not foreshortened.
    px_per_mm : float
        At the isocentre. How far a catheter may bend depends on lengths in millimetres.
    angles_rad : (electrodes,), optional
        Places of the electrodes on a loop, from the tip on.

    Returns
    -------
    (n, electrodes) int
        Indices of the candidates from the tip on.
    """
    kept, ratios = np.empty((len(points), len(spacing_px) + 1), np.int64), np.empty((len(points), len(spacing_px)))
    kept[:, 0] = np.arange(len(points))
    cosines = _least_cosines(spacing_px / px_per_mm)
    for step in range(len(spacing_px)):
        most = min(len(kept) * len(points), _GROWN)
        longer, more = np.empty((most, kept.shape[1]), np.int64), np.empty((most, ratios.shape[1]))
        count = _grow(points, spacing_px, step, cosines[step], _RING_MM * px_per_mm, kept, ratios, longer, more)
        kept, ratios = longer[:count], more[:count]
        if count > _PARTIAL:
            values = weights[kept[:, : step + 2]].sum(axis=1)
            if angles_rad is not None:
                off = off_ellipse(points[kept[:, : step + 2]], angles_rad[: step + 2]) / spacing_px.mean() ** 2
                values -= 0.5 * off / (_OFF_ELLIPSE * _OFF_ELLIPSE)
            best = np.argpartition(-values, _PARTIAL)[:_PARTIAL]
            kept, ratios = kept[best], ratios[best]
    mean = ratios.mean(axis=1)
    possible: IntArray = kept[(mean >= SHORTEST) & (mean <= LONGEST)]
    return possible


def _least_cosines(spacing_mm: Array) -> Array:
    """Return the cosine of the largest bend at the first electrode of each gap, (gaps,)."""
    least = np.full(len(spacing_mm), _LEAST_COSINE)
    between = 0.5 * (spacing_mm[:-1] + spacing_mm[1:])
    if len(spacing_mm) + 1 < MANY_ELECTRODES:
        between[np.minimum(spacing_mm[:-1], spacing_mm[1:]) < _WIDE_GAPS_MM] = 0.0
    least[1:] = np.minimum(least[1:], np.cos(np.minimum(_MOST_CURVED_PER_MM * between, _MOST_BENT)))
    return least


@kernel("f8[:,::1], f8[::1], i8, f8, f8, i8[:,::1], f8[:,::1], i8[:,::1], f8[:,::1]")
def _grow(points, spacing_px, step, least_cosine, ring_px, kept, ratios, longer, more):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write all paths with one more electrode; return their number.

    Their spacing ratios are written too.
    """
    count = 0
    spacing = spacing_px[step]
    shortest = SHORTEST * _END_SLACK[0] * spacing
    longest = LONGEST * max(_END_SLACK[1] * spacing, spacing + ring_px)
    for row in range(kept.shape[0]):
        last = kept[row, step]
        bu = bv = before = 0.0
        if step > 0:
            bu = points[last, 0] - points[kept[row, step - 1], 0]
            bv = points[last, 1] - points[kept[row, step - 1], 1]
            before = spacing_px[step - 1]
        straight = least_cosine * math.sqrt(bu * bu + bv * bv)
        for i in range(points.shape[0]):
            du = points[i, 0] - points[last, 0]
            dv = points[i, 1] - points[last, 1]
            length = math.sqrt(du * du + dv * dv)
            if length < shortest or length > longest or i == last or count == longer.shape[0]:
                continue
            fits = True
            if step > 0 and bu * du + bv * dv < straight * length:
                # A steeply foreshortened catheter shows a gentle bend in space as a sharp bend in the image.
                tu, tv = bu / before - du / spacing, bv / before - dv / spacing
                fits = tu * tu + tv * tv <= _MOST_TURNED * _MOST_TURNED
            for k in range(step):
                spread = min(_SPREAD + _SPREAD_A_GAP * (step - 1 - k), _MOST_SPREAD)
                if kept[row, k] == i or abs(ratios[row, k] - length / spacing) > spread:
                    fits = False
            if fits:
                longer[count, 0] = kept[row, 0]
                for k in range(step):
                    longer[count, k + 1] = kept[row, k + 1]
                    more[count, k] = ratios[row, k]
                longer[count, step + 1] = i
                more[count, step] = length / spacing
                count += 1
    return count


def count_shared(chosen: IntArray, points: Array, near_px: float, most: int) -> IntArray:
    """Return how many candidates each two chains have in common, (n, n).

    ``most`` is added to the number of two chains that exclude each other. They do in two cases:

    - ``most`` electrodes of one chain lie within ``near_px`` of the other's, because a wide ring may give two candidates.
    - Some chain is long, and both take turns along one catheter: two electrodes of one chain lie between those of the other, or
      the electrodes between and those at the same places are ``most`` together.

    Rows of ``chosen`` are filled up with -1.
    """
    used = np.flatnonzero(np.bincount(chosen.ravel() + 1, minlength=len(points) + 1)[1:])
    member = np.zeros((len(chosen), len(points) + 1), np.float32)
    member[np.arange(len(chosen))[:, None], chosen] = 1.0
    member = member[:, used]
    u, v = points[used].T
    square = (u[:, None] - u) ** 2 + (v[:, None] - v) ** 2
    near = (member @ (square < near_px * near_px).astype(np.float32) > 0).astype(np.float32)
    close = member @ near.T >= most
    if chosen.shape[1] >= MANY_ELECTRODES:
        lies_between = _lies_between(chosen, points, points[used], _IN_LINE * near_px) & (near == 0)
        between = lies_between.astype(np.float32) @ member.T
        close |= (between >= _INTERLEAVED) | ((between > 0) & (between + between.T + near @ member.T >= most))
    common: IntArray = (member @ member.T).astype(np.int64)
    common[close | close.T] += most
    return common


def _lies_between(chosen: IntArray, points: Array, places: Array, near_px: float) -> BoolArray:
    """Return which places lie along which chain, (n, places).

    A place lies along a chain where it is less than ``near_px`` beside one of its gaps. Rows of ``chosen`` are filled up
    with -1.
    """
    starts, ends = points[chosen[:, :-1]], points[chosen[:, 1:]]
    is_gap = chosen[:, 1:] >= 0
    along = ends - starts
    away = places[:, None, None] - starts
    share = (away * along).sum(axis=-1) / np.maximum((along * along).sum(axis=-1), 1e-9)
    beside = away - share[..., None] * along
    within = (share > 0) & (share < 1) & ((beside * beside).sum(axis=-1) < near_px * near_px) & is_gap
    lies: BoolArray = within.any(axis=-1).T
    return lies


def best_set(values: Array, shared: IntArray, family: IntArray, capacity: IntArray, price: float) -> IntArray:
    """Return the indices of the best set of chains by branch and bound.

    The best set has the largest sum of values less ``price`` for each shared candidate. It has at most ``capacity``
    chains of each family, and two of its chains share one candidate at most. For a catalogue of very many catheters the
    search ends after 300000 tries.

    Parameters
    ----------
    values : (n,)
        Descending.
    shared : (n, n)
        See :func:`count_shared`.
    family : (n,)
        Family of each chain.
    capacity : (families,)
        Largest number of chains of each family.
    price : float
    """
    most = int(capacity.sum())
    stack, best = np.zeros((2, most), np.int64)
    return best[: _branch_and_bound(values, shared, family, capacity.copy(), price, stack, np.zeros(most + 1), best)]


@kernel("f8[::1], i8[:,::1], i8[::1], i8[::1], f8, i8[::1], f8[::1], i8[::1]")
def _branch_and_bound(values, shared, family, left, price, stack, gained, best):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the best set to ``best`` and return its size.

    ``left`` : how many more chains of each family may be chosen.
    """
    most = stack.size
    size = 0
    best_value = 0.0
    depth = 0
    following = 0
    for _ in range(_MOST_TRIES):
        index = following
        overlap = 0
        while depth < most and index < values.size:
            if gained[depth] + (most - depth) * values[index] <= best_value:
                index = values.size
                break
            overlap = 0
            for k in range(depth):
                overlap += shared[index, stack[k]]
            if left[family[index]] > 0 and overlap <= 1:
                break
            index += 1
        if depth < most and index < values.size:
            stack[depth] = index
            left[family[index]] -= 1
            gained[depth + 1] = gained[depth] + values[index] - price * overlap
            depth += 1
            following = index + 1
            if gained[depth] > best_value:
                best_value = gained[depth]
                size = depth
                for k in range(depth):
                    best[k] = stack[k]
        elif depth > 0:
            depth -= 1
            left[family[stack[depth]]] += 1
            following = stack[depth] + 1
        else:
            break
    return size
