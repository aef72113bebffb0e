"""The beats of a recording: the deflections of the reference that have one shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array
from fluoromap.electrogram.deflections import Channel

_REFRACTORY_MS = 100.0
"""No tissue is activated twice within this time: the shortest cycles of fibrillation are about as long."""
_SHAPE_MS = 10.0
_ALIKE = 0.8
"""Correlation of two beats of one shape."""
_AS_STEEP = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Beats:
    """The beats of the reference.

    samples : where they are steepest, ascending. others : number of deflections of other shapes that are about as steep.
    """

    samples: Array
    others: int


def find_beats(reference: Channel) -> Beats:
    """Return the deflections of the reference that have its commonest steep shape.

    A premature beat has another shape; so has the far field of the other chambers. Of two shapes the commoner counts unless it is
    much flatter.
    """
    slopes = -reference.slopes
    apart = _REFRACTORY_MS / reference.spacing_ms
    kept: list[int] = []
    for sample in sorted(reference.steep.tolist(), key=lambda sample: -slopes[sample]):
        if all(abs(sample - one) >= apart for one in kept):
            kept.append(sample)
    groups: list[list[int]] = []
    for sample in kept:
        alike = next((group for group in groups if _correlation(reference, group[0], sample) >= _ALIKE), None)
        if alike is None:
            groups.append([sample])
        else:
            alike.append(sample)
    if not groups:
        return Beats(np.zeros(0, np.int64), 0)

    def weight(group: list[int]) -> float:
        return float(len(group) ** 2 * np.median(slopes[group]))

    chosen = max(groups, key=weight)
    steep = _AS_STEEP * float(np.median(slopes[chosen]))
    others = sum(slopes[sample] >= steep for group in groups if group is not chosen for sample in group)
    return Beats(np.array(sorted(chosen), np.int64), int(others))


def _correlation(channel: Channel, first: int, second: int) -> float:
    """Return how alike two deflections are, aligned at their steepest places."""
    reach = round(_SHAPE_MS / channel.spacing_ms)
    n = len(channel.signal)
    before = min(reach, first, second)
    behind = min(reach, n - 1 - first, n - 1 - second)
    a, b = (channel.signal[sample - before : sample + behind + 1] for sample in (first, second))
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / max(float(np.sqrt((a @ a) * (b @ b))), 1e-300))
