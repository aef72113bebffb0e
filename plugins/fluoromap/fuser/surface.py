"""Closed triangle surfaces: hull, refinement, nearest points, distances along the surface, area and volume.

A surface is ``vertices_mm`` (n, 3) and ``faces`` (f, 3), outward by the right-hand rule; any frame of reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist

from fluoromap.contracts import Array, BoolArray, IntArray

MOST_FACES = 40_000
"""Limit of a surface's faces, above the need of any chamber at 1 mm: wrong coordinates must not exhaust the memory."""
_POINTS_AT_ONCE = 64
"""Points whose nearest faces are searched together, so that a thousand points need little memory."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on a surface, projected from points in space.

    positions_mm : (k, 3). faces : (k,), weights : (k, 3), the face of each and barycentric weights in it. distance_mm :
    (k,), from the point in space.
    """

    positions_mm: Array
    faces: IntArray
    weights: Array
    distance_mm: Array

    def rows(self, faces: IntArray, vertices: int) -> csr_array:
        """Return the sparse (k, n) matrix that interpolates vertex values at the points."""
        k = len(self.faces)
        where = (np.repeat(np.arange(k), 3), faces[self.faces].ravel())
        return coo_array((self.weights.ravel(), where), shape=(k, vertices)).tocsr()


def hull_surface(points_mm: Array) -> tuple[Array, IntArray]:
    """Return the convex hull of points (k, 3).

    It is a closed outward surface of its extreme points. There are at least four points, not all in one plane.
    """
    hull = ConvexHull(points_mm)
    if not is_watertight(np.asarray(hull.simplices, dtype=np.int64)):
        # Qhull's triangulation of facets with many coplanar points can leave holes; joggled input (QJ) never does.
        hull = ConvexHull(points_mm, qhull_options="QJ")
    faces: IntArray = np.array(hull.simplices, dtype=np.int64)
    corners = points_mm[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normals * hull.equations[:, :3]).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    used, renumbered = np.unique(faces, return_inverse=True)
    return points_mm[used], renumbered.reshape(-1, 3).astype(np.int64)


def is_watertight(faces: IntArray) -> bool:
    """Return True where every edge belongs to exactly two faces."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return bool((counts == 2).all())


def face_normals(vertices_mm: Array, faces: IntArray) -> Array:
    """Return the outward normals (f, 3).

    The length of each is twice its face's area in mm².
    """
    corners = vertices_mm[faces]
    normals: Array = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals


def face_areas_mm2(vertices_mm: Array, faces: IntArray) -> Array:
    """Return the areas (f,) of the faces, mm²."""
    areas: Array = np.linalg.norm(face_normals(vertices_mm, faces), axis=1) / 2
    return areas


def volume_mm3(vertices_mm: Array, faces: IntArray) -> float:
    """Return the enclosed volume by the divergence theorem; positive where faces are outward."""
    corners = vertices_mm[faces] - vertices_mm.mean(axis=0)
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def refine(vertices_mm: Array, faces: IntArray, edge_mm: float) -> tuple[Array, IntArray]:
    """Split edges until none is longer than ``edge_mm``.

    The shape, the closedness and the given vertices stay. The longest edges are split first, so that triangles do not
    become needles. Where the result would have more than ``MOST_FACES`` faces, the edges stay longer.
    """
    area = float(face_areas_mm2(vertices_mm, faces).sum())
    # Halving leaves edges of 1/2 to 1 of the target, so that a triangle's area is about a fifth of the target's square.
    target = max(edge_mm, float(np.sqrt(area / (0.2 * MOST_FACES))))
    while len(faces) < MOST_FACES:
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        # Sorting one number an edge is several times faster than sorting pairs.
        numbers, of_edge = np.unique(edges[:, 0] * len(vertices_mm) + edges[:, 1], return_inverse=True)
        unique = np.stack(np.divmod(numbers, len(vertices_mm)), axis=1)
        lengths = np.linalg.norm(vertices_mm[unique[:, 0]] - vertices_mm[unique[:, 1]], axis=1)
        longest = float(lengths.max())
        if longest <= target:
            break
        split = lengths > max(target, 0.7 * longest)
        middle = np.full(len(unique), -1)
        middle[split] = len(vertices_mm) + np.arange(int(split.sum()))
        vertices_mm = np.concatenate([vertices_mm, vertices_mm[unique[split]].mean(axis=1)])
        faces = _split_faces(vertices_mm, faces, middle[of_edge.ravel()].reshape(-1, 3))
    return vertices_mm, faces


def _split_faces(vertices_mm: Array, faces: IntArray, middles: IntArray) -> IntArray:
    """Replace each face by 1 to 4 faces.

    ``middles`` (f, 3) are the new vertices on the edges 01, 12, 20 of each face; -1 where an edge stays whole.
    """
    count = (middles >= 0).sum(axis=1)
    parts = [faces[count == 0]]

    # One split edge: rotate the corners so that it is edge 01.
    a, b, c, m, _, _ = _rotate_corners(faces, middles, count == 1, np.argmax(middles >= 0, axis=1))
    parts += [np.stack([a, m, c], 1), np.stack([m, b, c], 1)]

    # Two split edges: rotate the corners so that the whole edge is 20; use the quadrilateral's shorter diagonal.
    a, b, c, m, k, _ = _rotate_corners(faces, middles, count == 2, (np.argmin(middles, axis=1) + 1) % 3)
    parts.append(np.stack([m, b, k], 1))
    first = np.linalg.norm(vertices_mm[a] - vertices_mm[k], axis=1)
    second = np.linalg.norm(vertices_mm[m] - vertices_mm[c], axis=1)
    near = (first < second)[:, None]
    parts.append(np.where(near, np.stack([a, m, k], 1), np.stack([a, m, c], 1)))
    parts.append(np.where(near, np.stack([a, k, c], 1), np.stack([m, k, c], 1)))

    a, b, c, m, k, j = _rotate_corners(faces, middles, count == 3, np.zeros(len(faces), dtype=np.int64))
    parts += [np.stack(corner, 1) for corner in ((a, m, j), (m, b, k), (j, k, c), (m, k, j))]
    return np.concatenate(parts).astype(np.int64)


def _rotate_corners(faces: IntArray, middles: IntArray, which: BoolArray, turn: IntArray) -> tuple[IntArray, ...]:
    order = (turn[which][:, None] + np.arange(3)) % 3
    corners = np.take_along_axis(faces[which], order, axis=1)
    halves = np.take_along_axis(middles[which], order, axis=1)
    return (*corners.T, *halves.T)


def nearest_on_surface(vertices_mm: Array, faces: IntArray, points_mm: Array) -> SurfacePoints:
    """Return the nearest surface point of each of the points (k, 3)."""
    corners = vertices_mm[faces]
    middles = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    index, weight = np.empty(len(points_mm), dtype=np.int64), np.empty((len(points_mm), 3))
    for first in range(0, len(points_mm), _POINTS_AT_ONCE):
        some = slice(first, first + _POINTS_AT_ONCE)
        away = cdist(points_mm[some], middles)
        # Only a face whose circle is nearer than the nearest face middle can contain the nearest point.
        of_point, candidates = np.nonzero(away - reach <= away.min(axis=1, keepdims=True))
        starts = np.searchsorted(of_point, np.arange(len(away)))
        found, weight[some] = _nearest_in_faces(corners[candidates], points_mm[some][of_point], starts)
        index[some] = candidates[found]
    positions = np.einsum("kc,kcx->kx", weight, vertices_mm[faces[index]])
    return SurfacePoints(positions, index, weight, np.linalg.norm(positions - points_mm, axis=1))


def _nearest_in_faces(corners_mm: Array, points_mm: Array, starts: IntArray) -> tuple[IntArray, Array]:
    """Return the nearest of its faces for each of k points.

    Parameters
    ----------
    corners_mm : ndarray, shape (f, 3, 3)
        Corners of the faces, those of the first point first.
    points_mm : ndarray, shape (f, 3)
        The point of each face.
    starts : ndarray, shape (k,)
        First face of each point.

    Returns
    -------
    ndarray, shape (k,), and ndarray, shape (k, 3)
        Indices of the faces, and the barycentric weights of the nearest points in them.
    """
    a, ab, ac = corners_mm[:, 0], corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0]
    bc = corners_mm[:, 2] - corners_mm[:, 1]
    aa, bb, cc = (np.maximum((edge**2).sum(axis=1), 1e-12) for edge in (ab, ac, bc))
    cross = (ab * ac).sum(axis=1)
    determinant = np.maximum(aa * bb - cross**2, 1e-12 * aa * bb)
    offset = points_mm - a
    along_ab, along_ac = (offset * ab).sum(axis=1), (offset * ac).sum(axis=1)
    v = (bb * along_ab - cross * along_ac) / determinant
    w = (aa * along_ac - cross * along_ab) / determinant
    t_ab, t_ac = np.clip(along_ab / aa, 0, 1), np.clip(along_ac / bb, 0, 1)
    t_bc = np.clip(((points_mm - corners_mm[:, 1]) * bc).sum(axis=1) / cc, 0, 1)
    zero = np.zeros_like(v)
    # The foot of the perpendicular counts where it lies inside the face, else the nearest point of the three edges.
    outside = (v < 0) | (w < 0) | (v + w > 1)
    inner = np.where(outside[:, None], [1.0, 0.0, 0.0], np.stack([1 - v - w, v, w], 1))
    candidates = np.stack([
        np.stack([1 - t_ab, t_ab, zero], 1), np.stack([1 - t_ac, zero, t_ac], 1),
        np.stack([zero, 1 - t_bc, t_bc], 1), inner,
    ])  # fmt: skip
    distances = np.linalg.norm(np.einsum("cfk,fkx->cfx", candidates, corners_mm) - points_mm, axis=2)
    least = np.minimum.reduceat(distances, starts, axis=1)
    which = np.argmin(least, axis=0)
    of_face = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(corners_mm)))
    is_least = distances[which[of_face], np.arange(len(of_face))] == least[which, np.arange(len(starts))][of_face]
    faces = np.minimum.reduceat(np.where(is_least, np.arange(len(of_face)), len(of_face)), starts)
    return faces, candidates[which, faces]


def distance_along_surface(vertices_mm: Array, faces: IntArray, points: SurfacePoints, limit_mm: float) -> Array:
    """Return the distance (n,) along the surface from each vertex to the nearest of the points.

    It is infinite beyond ``limit_mm``. Dijkstra's shortest paths use the mesh edges and, across each edge, the straight
    line between its two opposite vertices with both faces laid flat. They are never shorter than the true geodesic, 2 to
    3 % longer on average and up to a fifth longer where triangles are needles. Colour therefore ends a little early rather
    than late.
    """
    n, k = len(vertices_mm), len(points.faces)
    edges, lengths = _edges_and_shortcuts(vertices_mm, faces)
    to_corner = np.linalg.norm(vertices_mm[faces[points.faces]] - points.positions_mm[:, None], axis=2)
    row = np.concatenate([edges[:, 0], n + np.repeat(np.arange(k), 3)])
    column = np.concatenate([edges[:, 1], faces[points.faces].ravel()])
    # A point on a vertex has distance 0, which means "no connection" in a sparse graph.
    weight = np.maximum(np.concatenate([lengths, to_corner.ravel()]), 1e-9)
    graph = coo_array((weight, (row, column)), shape=(n + k, n + k)).tocsr()
    distance: Array = dijkstra(graph, directed=False, indices=n + np.arange(k), limit=limit_mm, min_only=True)
    return distance[:n]


def _edges_and_shortcuts(vertices_mm: Array, faces: IntArray) -> tuple[IntArray, Array]:
    """Return the edges and shortcuts of a surface with their lengths.

    A shortcut is a straight line across an edge that stays within the edge's two faces.
    """
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    opposite = faces[:, [2, 0, 1]].ravel()
    order = np.lexsort((np.sort(half, axis=1)[:, 1], np.sort(half, axis=1)[:, 0]))
    first, second = order[0::2], order[1::2]
    edge = half[first]
    start, direction = vertices_mm[edge[:, 0]], vertices_mm[edge[:, 1]] - vertices_mm[edge[:, 0]]
    length = np.linalg.norm(direction, axis=1)
    unit = direction / np.maximum(length, 1e-12)[:, None]

    def flat(vertex: IntArray) -> tuple[Array, Array]:
        offset = vertices_mm[vertex] - start
        along = (offset * unit).sum(axis=1)
        return along, np.linalg.norm(offset - along[:, None] * unit, axis=1)

    p, q = opposite[first], opposite[second]
    (along_p, height_p), (along_q, height_q) = flat(p), flat(q)
    crossing = (along_p * height_q + along_q * height_p) / np.maximum(height_p + height_q, 1e-12)
    inside = (crossing > 0) & (crossing < length)
    across = np.hypot(along_p - along_q, height_p + height_q)
    shortcuts = np.stack([p, q], 1)[inside]
    return np.concatenate([edge, shortcuts]), np.concatenate([length, across[inside]])
