"""Lines of equal activation time on the chamber's surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, ChamberMap, IntArray
from fluoromap.fuser.reentry_cycle import around


@dataclass(frozen=True, eq=False)
class Isochrone:
    """One connected line of equal time.

    points_mm : (m, 3) in the map's frame, first and last equal where the line is closed. faces : (m - 1,) the face of each
    segment.
    """

    lat_ms: float
    points_mm: Array
    faces: IntArray


def isochrones(chamber: ChamberMap, levels_ms: Array) -> tuple[Isochrone, ...]:
    """Return the lines of the given times through the covered faces.

    Times are linear within a face. Where they repeat after a cycle, the difference between two corners is taken by the
    shorter way around, so that lines do not crowd where early meets late. A line ends where activation rotates about a
    point.
    """
    covered = np.flatnonzero(chamber.covered[chamber.faces].all(axis=1))
    corners = chamber.faces[covered].T
    return tuple(line for level in levels_ms for line in _lines(chamber, covered, corners, float(level)))


def _lines(chamber: ChamberMap, covered: IntArray, corners: IntArray, level: float) -> list[Isochrone]:
    """Return the lines of one time; ``corners`` (3, c) are those of the covered faces."""
    after, cycle = chamber.lat_ms - level, chamber.cycle_length_ms
    if cycle is not None:
        after = around(after, cycle)
    # A vertex exactly on the level counts as later, so that a crossed face always has two crossed edges.
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
    # One number for each edge, the same from both its faces.
    vertices = len(chamber.vertices_mm)
    edges = np.minimum(corners, opposite) * vertices + np.maximum(corners, opposite)
    lines = []
    for edge_chain, segment_chain in _chains(edges.T[cut.T].reshape(-1, 2)):
        a, b = np.divmod(edge_chain, vertices)
        share = (after[a] / (after[a] - after[b]))[:, None]
        points = (1 - share) * chamber.vertices_mm[a] + share * chamber.vertices_mm[b]
        lines.append(Isochrone(level, points, covered[crossed[segment_chain]]))
    return lines


def _chains(segments: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Join segments (s, 2) into chains.

    Two segments join end to end where they alone meet in a node. The result is (nodes, segments) of each chain.
    """
    ends, nodes = np.unique(segments, return_inverse=True)
    nodes = nodes.reshape(-1, 2)
    numbers = np.arange(1, len(segments) + 1)
    # Sums of a node's two segments (counted from 1) and of a segment's two nodes: the sum minus one is the other.
    at = np.bincount(nodes.ravel(), np.repeat(numbers, 2)).astype(np.int64).tolist()
    passable = (np.bincount(nodes.ravel()) == 2).tolist()
    across = [0, *nodes.sum(axis=1).tolist()]
    left = [False, *([True] * len(segments))]
    chains = []

    def walk(node: int, segment: int) -> None:
        chain_nodes, chain_segments = [node], list[int]()
        while left[segment]:
            left[segment] = False
            chain_segments.append(segment)
            node = across[segment] - node
            chain_nodes.append(node)
            segment = at[node] - segment if passable[node] else 0
        chains.append((ends[chain_nodes], np.array(chain_segments) - 1))

    # Open chains first, from their ends; all remaining chains are closed.
    pairs = list(zip(numbers.tolist(), nodes.tolist(), strict=True))
    starts = [(node, number) for number, pair in pairs for node in pair if not passable[node]]
    for node, number in [*starts, *((pair[0], number) for number, pair in pairs)]:
        if left[number]:
            walk(node, number)
    return chains
