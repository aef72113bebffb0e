"""Lines of equal activation time on the chamber's surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, ChamberMap, IntArray
from fluoromap.fuser.cycle import around


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
    edges = np.sort(chamber.faces[covered][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    # One number an edge sorts several times faster than a pair.
    numbers, of_face = np.unique(edges[:, 0] * len(chamber.vertices_mm) + edges[:, 1], return_inverse=True)
    ends = np.stack(np.divmod(numbers, len(chamber.vertices_mm)), axis=1)
    of_face = of_face.reshape(-1, 3)
    return tuple(line for level in levels_ms for line in _lines(chamber, covered, of_face, ends, float(level)))


def _lines(chamber: ChamberMap, covered: IntArray, of_face: IntArray, ends: IntArray, level: float) -> list[Isochrone]:
    """Of one time: ``of_face`` (c, 3) the edges of the covered faces, ``ends`` (e, 2) the vertices of the edges."""
    after, cycle = chamber.lat_ms - level, chamber.cycle_length_ms
    if cycle is not None:
        after = around(after, cycle)
    first, second = after[ends].T
    # A vertex exactly on the level counts as later, so that a crossed face has exactly two crossed edges.
    cut = (first >= 0) != (second >= 0)
    if cycle is not None:
        cut &= np.abs(first - second) < cycle / 2
    of_crossed = cut[of_face]
    crossed = np.flatnonzero(of_crossed.sum(axis=1) == 2)
    if not len(crossed):
        return []
    segments = of_face[crossed][of_crossed[crossed]].reshape(-1, 2)
    lines = []
    for edges, used in _chains(segments):
        share = (first[edges] / (first[edges] - second[edges]))[:, None]
        a, b = chamber.vertices_mm[ends[edges]].swapaxes(0, 1)
        lines.append(Isochrone(level, (1 - share) * a + share * b, covered[crossed[used]]))
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
