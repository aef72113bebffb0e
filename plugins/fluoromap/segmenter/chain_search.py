"""The kernels behind linking: paths through candidates, their scores, and the best set of them by branch and bound."""

from __future__ import annotations

import numpy as np
from numba import njit

SHORTEST, LONGEST = 0.45, 1.12
"""A spacing seen over the same spacing lying across the rays at the isocentre: foreshortened, or nearer to the source."""

_END_SLACK = 0.8, 1.1
_SPREAD = 0.45
_LEAST_COSINE = 0.55
_SPACING_SD = 0.06
_BEND_SD = 0.40
_S_BEND, _S_BEND_WEIGHT = 0.12, 1.5
_FORESHORTENED, _FORESHORTENED_WEIGHT = 0.75, 2.0
_UNLIKE_WEIGHT = 0.6
_BEHIND_MM = 2.4, 5.9
_BEFORE_MM = 2.1, 3.5
_PARTIAL = 1500
_GROWN = 60000
_MOST_TRIES = 300000


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def paths(points, weights, spacing_px):  # type: ignore[no-untyped-def]  # pragma: no cover
    """All orders of candidates whose spacings and bends a catheter could show, (n, electrodes) indices from the tip on; of
    each length the 1500 of most evidence go on."""
    n = points.shape[0]
    m = spacing_px.size + 1
    kept = np.empty((n, m), np.int64)
    ratios = np.empty((n, m - 1), np.float64)
    values = weights.copy()
    for i in range(n):
        kept[i, 0] = i
    for step in range(m - 1):
        grown = np.empty((_GROWN, 2), np.int64)
        ratio = np.empty(_GROWN, np.float64)
        value = np.empty(_GROWN, np.float64)
        count = 0
        shortest = SHORTEST * _END_SLACK[0] * spacing_px[step]
        longest = LONGEST * _END_SLACK[1] * spacing_px[step]
        for row in range(kept.shape[0]):
            last = kept[row, step]
            for i in range(n):
                du = points[i, 0] - points[last, 0]
                dv = points[i, 1] - points[last, 1]
                square = du * du + dv * dv
                if square < shortest * shortest or square > longest * longest or count == _GROWN:
                    continue
                length = np.sqrt(square)
                seen = length / spacing_px[step]
                fits = True
                for k in range(step):
                    if kept[row, k] == i or abs(ratios[row, k] - seen) > _SPREAD:
                        fits = False
                        break
                if not fits or i == last:
                    continue
                if step > 0:
                    before = kept[row, step - 1]
                    bu = points[last, 0] - points[before, 0]
                    bv = points[last, 1] - points[before, 1]
                    if bu * du + bv * dv < _LEAST_COSINE * length * np.sqrt(bu * bu + bv * bv):
                        continue
                grown[count, 0] = row
                grown[count, 1] = i
                ratio[count] = seen
                value[count] = values[row] + weights[i]
                count += 1
        order = np.argsort(-value[:count])[:_PARTIAL]
        longer = np.empty((order.size, m), np.int64)
        more = np.empty((order.size, m - 1), np.float64)
        for k in range(order.size):
            longer[k] = kept[grown[order[k], 0]]
            more[k] = ratios[grown[order[k], 0]]
            longer[k, step + 1] = grown[order[k], 1]
            more[k, step] = ratio[order[k]]
        kept, ratios, values = longer, more, value[order]
    count = 0
    for k in range(kept.shape[0]):
        mean = ratios[k].mean()
        if SHORTEST <= mean <= LONGEST:
            kept[count] = kept[k]
            count += 1
    return kept[:count]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def spacing_fit(points, spacing_px, variance_px2):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Log-likelihood, up to a constant, of the points' spacings as these, one foreshortening free.

    ``variance_px2`` is each point's own; each ratio of seen to true spacing has that of its two ends and of the bend.
    """
    weights = total = squares = 0.0
    for k in range(spacing_px.size):
        seen = np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]) / spacing_px[k]
        weight = 1.0 / (_SPACING_SD**2 + (variance_px2[k] + variance_px2[k + 1]) / spacing_px[k] ** 2)
        weights += weight
        total += weight * seen
        squares += weight * seen * seen
    return -0.5 * (squares - total * total / weights)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def dark_line(x, reduction, u0, v0, u1, v1, side):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Mean over the piece of (darker of the two sides - middle); what leaves the image does not count.

    Ends and ``side`` in pixels of the frame, of which ``x`` is the ``reduction`` times smaller image.
    """
    rows, columns = x.shape
    shift = 0.5 / reduction - 0.5
    u0, v0, u1, v1 = u0 / reduction + shift, v0 / reduction + shift, u1 / reduction + shift, v1 / reduction + shift
    side /= reduction
    du, dv = u1 - u0, v1 - v0
    length = np.sqrt(du * du + dv * dv) + 1e-9
    across_u, across_v = -dv / length * side, du / length * side
    steps = max(3, int(length * reduction / 2))
    total = 0.0
    count = 0
    for i in range(steps):
        t = (i + 0.5) / steps
        cu, cv = u0 + t * du, v0 + t * dv
        if (
            min(cu - abs(across_u), cv - abs(across_v)) < 0
            or cu + abs(across_u) > columns - 1
            or cv + abs(across_v) > rows - 1
        ):
            continue
        one = x[int(cv + across_v + 0.5), int(cu + across_u + 0.5)]
        other = x[int(cv - across_v + 0.5), int(cu - across_u + 0.5)]
        total += min(one, other) - x[int(cv + 0.5), int(cu + 0.5)]
        count += 1
    return total / count if count > 0 else 0.0


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def shaft_evidence(points, widest, tip_mm, px_per_mm, smooth, reduction, clear, side):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Dark between the electrodes of the widest gap and behind the last electrode, not before the tip: -3 to 3.

    ``clear`` is what counts as a clear shaft in ``smooth``; ``side`` how far beside a shaft its surroundings are looked at.
    """
    last = points.shape[0] - 1
    du, dv = points[widest + 1, 0] - points[widest, 0], points[widest + 1, 1] - points[widest, 1]
    between = dark_line(
        smooth, reduction, points[widest, 0] + 0.25 * du, points[widest, 1] + 0.25 * dv,
        points[widest, 0] + 0.75 * du, points[widest, 1] + 0.75 * dv, side,
    )  # fmt: skip
    du, dv = points[last, 0] - points[last - 1, 0], points[last, 1] - points[last - 1, 1]
    scale = px_per_mm / max(np.sqrt(du * du + dv * dv), 1e-9)
    near, far = _BEHIND_MM[0] * scale, _BEHIND_MM[1] * scale
    behind = dark_line(
        smooth, reduction, points[last, 0] + near * du, points[last, 1] + near * dv,
        points[last, 0] + far * du, points[last, 1] + far * dv, side,
    )  # fmt: skip
    du, dv = points[0, 0] - points[1, 0], points[0, 1] - points[1, 1]
    scale = px_per_mm / max(np.sqrt(du * du + dv * dv), 1e-9)
    near = (0.5 * tip_mm + _BEFORE_MM[0]) * scale
    far = near + _BEFORE_MM[1] * scale
    before = dark_line(
        smooth, reduction, points[0, 0] + near * du, points[0, 1] + near * dv,
        points[0, 0] + far * du, points[0, 1] + far * dv, side,
    )  # fmt: skip
    return (
        min(max(between / clear, -1.0), 1.0) + min(max(behind / clear, -1.0), 1.0) - min(max(before / clear, -1.0), 1.0)
    )


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def scores(  # type: ignore[no-untyped-def]  # pragma: no cover
    chosen, points, weights, variance_px2, sure, lost, spacing_px, tip_mm, px_per_mm, smooth, reduction, clear, side, shaft_weight,
    least,
):  # fmt: skip
    """Score of each path; -inf, without a look at the shaft, where that cannot lift it to ``least``."""
    count, m = chosen.shape
    out = np.full(count, -np.inf)
    widest = int(np.argmax(spacing_px))
    total = spacing_px.sum()
    place = np.empty((m, 2))
    variance = np.empty(m)
    for row in range(count):
        unsure = 0
        score = 0.0
        low, high = np.inf, -np.inf
        for k in range(m):
            candidate = chosen[row, k]
            place[k] = points[candidate]
            variance[k] = variance_px2[candidate]
            score += weights[candidate]
            unsure += candidate >= sure
            if k > 0:
                low = min(low, weights[candidate])
                high = max(high, weights[candidate])
        if 2 * unsure > m:
            continue
        score += spacing_fit(place, spacing_px, variance) - lost * unsure
        if m > 2:
            score -= _UNLIKE_WEIGHT * (high - low)
        seen = 0.0
        squares = 0.0
        left = right = 0.0
        before_u = before_v = 0.0
        for k in range(m - 1):
            du, dv = place[k + 1, 0] - place[k, 0], place[k + 1, 1] - place[k, 1]
            seen += np.sqrt(du * du + dv * dv)
            if k > 0:
                turn = np.arctan2(before_u * dv - before_v * du, before_u * du + before_v * dv)
                squares += turn * turn
                left, right = min(left, turn), max(right, turn)
            before_u, before_v = du, dv
        if left < -_S_BEND and right > _S_BEND:
            squares *= _S_BEND_WEIGHT**2
        score -= 0.5 * squares / _BEND_SD**2
        score -= _FORESHORTENED_WEIGHT * max(0.0, _FORESHORTENED - seen / total)
        if score + 3.0 * shaft_weight < least:
            continue
        score += shaft_weight * shaft_evidence(place, widest, tip_mm, px_per_mm, smooth, reduction, clear, side)
        if score >= least:
            out[row] = score
    return out


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def best_set(values, shared, family, capacity, price):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Branch and bound: indices of the chains, at most ``capacity`` of each family, whose values less ``price`` for each
    shared candidate add up to most. ``values`` fall; two chains share one candidate at most. A catalogue of very many
    catheters gets the best set of the first 300000 tries."""
    n = values.size
    most = capacity.sum()
    used = np.zeros(capacity.size, np.int64)
    stack = np.empty(most, np.int64)
    gained = np.zeros(most + 1)
    best = np.empty(0, np.int64)
    best_value = 0.0
    depth = 0
    following = 0
    for _ in range(_MOST_TRIES):
        descended = False
        if depth < most:
            for index in range(following, n):
                if gained[depth] + (most - depth) * values[index] <= best_value:
                    break
                if used[family[index]] == capacity[family[index]]:
                    continue
                overlap = 0
                for k in range(depth):
                    overlap += shared[index, stack[k]]
                if overlap > 1:
                    continue
                stack[depth] = index
                used[family[index]] += 1
                gained[depth + 1] = gained[depth] + values[index] - price * overlap
                depth += 1
                following = index + 1
                descended = True
                if gained[depth] > best_value:
                    best_value = gained[depth]
                    best = stack[:depth].copy()
                break
        if not descended:
            if depth == 0:
                return best
            depth -= 1
            used[family[stack[depth]]] -= 1
            following = stack[depth] + 1
    return best
