"""Lines of equal activation time on the chamber's surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, ChamberMap, IntArray
from fluoromap.fuser.reentry_cycle import around


@dataclass(frozen=True, eq=False)
class Isochrone:
    """One connected line of equal time.

    points_mm : (m, 3) in the map's frame, first and last equal where the line is closed. faces : (m - 1,) the face each
    segment lies in.
    """

    lat_ms: float
    points_mm: Array
    faces: IntArray


def isochrones(chamber: ChamberMap, levels_ms: Array) -> tuple[Isochrone, ...]:
    """Lines at the given times through the covered faces, times being linear within a face.

    Where times repeat after a cycle they are taken by the shorter way round from corner to corner, so that no lines crowd
    where early meets late; a line ends where activation turns about a point.
    """
    covered = np.flatnonzero(chamber.covered[chamber.faces].all(axis=1))
    corners = chamber.faces[covered].T
    return tuple(line for level in levels_ms for line in _lines(chamber, covered, corners, float(level)))


def _lines(chamber: ChamberMap, covered: IntArray, corners: IntArray, level: float) -> list[Isochrone]:
    """Of one time: ``corners`` (3, c) of the covered faces."""
    after, cycle = chamber.lat_ms - level, chamber.cycle_length_ms
    if cycle is not None:
        after = around(after, cycle)
    # A vertex exactly on the level counts as later, so that a crossed face has exactly two crossed edges.
    first, second, third = (after >= 0)[corners]
    crossed = np.flatnonzero((first != second) | (second != third))
    corners, opposite = corners[:, crossed], np.roll(corners[:, crossed], -1, axis=0)
    cut = (after[corners] >= 0) != (after[opposite] >= 0)
    if cycle is not None:
        cut &= np.abs(after[corners] - after[opposite]) < cycle / 2
        whole = cut.sum(axis=0) == 2
        crossed, corners, opposite, cut = crossed[whole], corners[:, whole], opposite[:, whole], cut[:, whole]
    if not len(crossed):
        return []
    # An edge as one number, the same from both its faces.
    vertices = len(chamber.vertices_mm)
    edges = np.minimum(corners, opposite) * vertices + np.maximum(corners, opposite)
    lines = []
    for passed, used in _chains(edges.T[cut.T].reshape(-1, 2)):
        a, b = np.divmod(passed, vertices)
        share = (after[a] / (after[a] - after[b]))[:, None]
        points = (1 - share) * chamber.vertices_mm[a] + share * chamber.vertices_mm[b]
        lines.append(Isochrone(level, points, covered[crossed[used]]))
    return lines


def _chains(segments: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Join segments (s, 2) end to end where two meet in a node. Returns (nodes, segments) of each chain."""
    ends, nodes = np.unique(segments, return_inverse=True)
    nodes = nodes.reshape(-1, 2)
    numbers = np.arange(1, len(segments) + 1)
    # A node's two segments, counted from 1, and a segment's nodes as sums: coming from one, the rest is the other.
    at = np.bincount(nodes.ravel(), np.repeat(numbers, 2)).astype(np.int64).tolist()
    passable = (np.bincount(nodes.ravel()) == 2).tolist()
    across = [0, *nodes.sum(axis=1).tolist()]
    left = [False, *([True] * len(segments))]
    chains = []

    def walk(node: int, segment: int) -> None:
        walked, passed = [node], list[int]()
        while left[segment]:
            left[segment] = False
            passed.append(segment)
            node = across[segment] - node
            walked.append(node)
            segment = at[node] - segment if passable[node] else 0
        chains.append((ends[walked], np.array(passed) - 1))

    # Open chains from their ends first; what remains is closed.
    pairs = list(zip(numbers.tolist(), nodes.tolist(), strict=True))
    starts = [(node, number) for number, pair in pairs for node in pair if not passable[node]]
    for node, number in [*starts, *((pair[0], number) for number, pair in pairs)]:
        if left[number]:
            walk(node, number)
    return chains
