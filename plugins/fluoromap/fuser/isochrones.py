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
    return tuple(line for level in levels_ms for line in _lines(chamber, covered, float(level)))


def _lines(chamber: ChamberMap, covered: IntArray, level: float) -> list[Isochrone]:
    after, cycle = chamber.lat_ms - level, chamber.cycle_length_ms
    if cycle is not None:
        after = around(after, cycle)
    # A vertex exactly on the level counts as later, so that a crossed face has exactly two crossed edges.
    later = after >= 0
    crossed = covered[np.ptp(later[chamber.faces[covered]].astype(np.int8), axis=1) > 0]
    corners = chamber.faces[crossed]
    edges = np.sort(np.stack([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]], axis=1), axis=2)
    first, second = edges[..., 0], edges[..., 1]
    cut = later[first] != later[second]
    if cycle is not None:
        cut &= np.abs(after[first] - after[second]) < cycle / 2
    whole = cut.sum(axis=1) == 2
    crossed, edges, cut = crossed[whole], edges[whole], cut[whole]
    if not len(crossed):
        return []
    pairs = edges[cut].reshape(-1, 2, 2)
    unique, ends = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    segments = ends.reshape(-1, 2)
    before, behind = after[unique[:, 0]], after[unique[:, 1]]
    share = (before / (before - behind))[:, None]
    points = (1 - share) * chamber.vertices_mm[unique[:, 0]] + share * chamber.vertices_mm[unique[:, 1]]
    return [
        Isochrone(level, points[nodes], crossed[np.array(used, dtype=np.int64)])
        for nodes, used in _chains(segments, len(points))
    ]


def _chains(segments: IntArray, nodes: int) -> list[tuple[list[int], list[int]]]:
    """Join segments (s, 2) end to end; each node lies in at most two. Returns (nodes, segments) of each chain."""
    at: list[list[int]] = [[] for _ in range(nodes)]
    for index, (a, b) in enumerate(segments.tolist()):
        at[a].append(index)
        at[b].append(index)
    left = set(range(len(segments)))
    chains = []
    # Open chains from their ends first; what remains are closed ones.
    for start in [*(node for node in range(nodes) if len(at[node]) == 1), *range(nodes)]:
        walked, used, node = [start], [], start
        while (onward := next((index for index in at[node] if index in left), None)) is not None:
            left.remove(onward)
            a, b = segments[onward].tolist()
            node = b if a == node else a
            walked.append(node)
            used.append(onward)
        if used:
            chains.append((walked, used))
    return chains
