"""Rasterisation: the face of a surface that each pixel of a picture shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.fuser.reentry_cycle import around


@dataclass(frozen=True, eq=False)
class Raster:
    """The nearest face of each pixel.

    face : (rows, columns), -1 where there is none. uv : (n, 2) the vertices in the picture; (0, 0) is the centre of the
    top-left pixel. faces : (f, 3). nearness : (n,) mm, larger is nearer to the viewer.
    """

    face: NDArray[np.int32]
    uv: Array
    faces: IntArray
    nearness: Array

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns outside of which no pixel shows a face."""
        corners = np.stack([np.floor(self.uv.min(axis=0)), np.ceil(self.uv.max(axis=0)) + 1])
        (left, upper), (right, lower) = np.clip(corners, 0, self.face.shape[::-1]).astype(np.int64).tolist()
        return slice(upper, lower), slice(left, right)

    def sample(self, pixels: IntArray, values: Array, cycle: float | None = None) -> Array:
        """Interpolate values (n,) of the vertices at pixels (p,), linearly within each face.

        Pixels are counted in row-major order; each must show a face. Where values repeat after ``cycle``, the difference
        between two corners is taken by the shorter way around; the result is within one cycle from the smallest value.
        """
        v, u = np.divmod(pixels, self.face.shape[1])
        uv = np.stack([u, v]).astype(np.float64).T
        sampled = self._inside(self.face.ravel()[pixels], uv, values, cycle)
        return sampled if cycle is None else values.min() + (sampled - values.min()) % cycle

    def visible(self, uv: Array, nearness: Array, tolerance_mm: float = 1.5) -> BoolArray:
        """Return which points (k, 2) are not behind the surface.

        ``nearness`` (k,) may be behind it by the tolerance.
        """
        rows, columns = self.face.shape
        pixel = np.rint(uv).astype(np.int64)
        u, v = np.clip(pixel[:, 0], 0, columns - 1), np.clip(pixel[:, 1], 0, rows - 1)
        face = self.face[v, u]
        inside = (pixel == np.stack([u, v], axis=1)).all(axis=1) & (face >= 0)
        answer = np.ones(len(uv), dtype=np.bool_)
        wall = self._inside(face[inside], uv[inside], self.nearness)
        answer[inside] = nearness[inside] >= wall - tolerance_mm
        return answer

    def _inside(self, face: NDArray[np.int32], uv: Array, values: Array, cycle: float | None = None) -> Array:
        faces = self.faces
        if len(face) < len(faces):
            faces, face = faces[face], np.arange(len(face), dtype=np.int32)
        # NumPy is slow along an axis of two or three: each coordinate of each corner is an operand of its own.
        u, v = (np.ascontiguousarray(coordinate)[faces.T] for coordinate in self.uv.T)
        at_corners = values[faces.T]
        if cycle is not None:
            at_corners = at_corners[0] + around(at_corners - at_corners[0], cycle)
        (first_u, second_u), (first_v, second_v) = u[1:] - u[0], v[1:] - v[0]
        determinant = first_u * second_v - first_v * second_u
        determinant = np.where(np.abs(determinant) < 1e-9, np.inf, determinant)
        rise, climb = at_corners[1:] - at_corners[0]
        slope_u = (rise * second_v - climb * first_v) / determinant
        slope_v = (climb * first_u - rise * second_u) / determinant
        offset_u, offset_v = uv[:, 0] - u[0][face], uv[:, 1] - v[0][face]
        value = at_corners[0][face] + slope_u[face] * offset_u + slope_v[face] * offset_v
        # A pixel on the rim of a face that is nearly edge-on must not get a value extrapolated far beyond the face.
        low, high = (of(of(at_corners[0], at_corners[1]), at_corners[2]) for of in (np.minimum, np.maximum))
        clipped: Array = np.clip(value, low[face], high[face])
        return clipped


def rasterise(uv: Array, nearness: Array, faces: IntArray, facing: BoolArray, shape: tuple[int, int]) -> Raster:
    """Paint the facing faces from the farthest to the nearest (painter's algorithm).

    A face covers the pixels whose centre lies in it.

    Parameters
    ----------
    uv, nearness : (n, 2), (n,)
        Vertices in the picture, and the nearness of each to the viewer in mm.
    faces, facing : (f, 3), (f,)
        Triangles, and True for those whose outer side faces the viewer.
    shape : (rows, columns)
    """
    rows, columns = shape
    # NumPy is slow along an axis of two or three: each coordinate of each corner is an operand of its own.
    front = np.flatnonzero(facing)
    u, v = (coordinate[faces[front].T] for coordinate in np.ascontiguousarray(uv.T))
    (left, upper), (right, lower) = ([of(of(c[0], c[1]), c[2]) for c in (u, v)] for of in (np.minimum, np.maximum))
    in_field = np.flatnonzero((right >= 0) & (lower >= 0) & (left <= columns - 1) & (upper <= rows - 1))
    order = in_field[np.argsort(nearness[faces[front[in_field]]].mean(axis=1), kind="stable")]
    front, u, v = front[order].astype(np.int32), u[:, order], v[:, order]
    # From the top corner down. Both faces of an edge compute the same crossing: no pixel between them is missed or shared.
    down = np.argsort(v, axis=0, kind="stable")
    u, v = np.take_along_axis(u, down, axis=0), np.take_along_axis(v, down, axis=0)
    of_triangle, first_row = _ranges(v[0], v[2], rows)
    row = _within(of_triangle, first_row)
    triangle = np.repeat(np.arange(len(front), dtype=np.int32), of_triangle)
    from_top, from_middle = _edges(u[:1], v[:1], u[1:], v[1:]), _edges(u[1:2], v[1:2], u[2:], v[2:])
    # The edges from the top corner to the middle and to the bottom one, and the edges from the middle corner.
    edges = np.concatenate([from_top, from_middle], axis=1)
    below = (row >= v[1][triangle]).astype(np.int32)
    long = _crossing(edges, triangle + np.int32(len(front)), row)
    short = _crossing(edges, triangle + below * np.int32(2 * len(front)), row)
    of_row, first_column = _ranges(np.minimum(long, short), np.maximum(long, short), columns)
    face = np.full(rows * columns, -1, dtype=np.int32)
    # NumPy keeps the last value assigned to a repeated index.
    face[_within(of_row, row * np.int32(columns) + first_column)] = np.repeat(front[triangle], of_row)
    return Raster(face.reshape(shape), uv, faces, nearness)


def _ranges(first: Array, last: Array, end: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the lengths and the first integers of ranges.

    Only integers within 0 to ``end`` count. Range k goes from ``first`` (k,) to below ``last`` (k,).
    """
    start, stop = (np.ceil(np.clip(bound, 0, end)).astype(np.int32) for bound in (first, last))
    return stop - start, start


def _within(count: NDArray[np.int32], start: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the integers of several ranges: ``count`` (k,) integers from ``start`` (k,) on."""
    past = np.cumsum(count, dtype=np.int32)
    return np.arange(past[-1] if len(past) else 0, dtype=np.int32) + np.repeat(start - past + count, count)


def _edges(upper_u: Array, upper_v: Array, lower_u: Array, lower_v: Array) -> Array:
    """Return edges (4, e): u and v of the upper end, height and width."""
    height = np.maximum(lower_v - upper_v, 1e-12)
    return np.stack([np.broadcast_to(of, height.shape).ravel() for of in (upper_u, upper_v, height, lower_u - upper_u)])


def _crossing(edges: Array, which: NDArray[np.int32], row: NDArray[np.int32]) -> Array:
    """Return the columns (k,) where some of the edges cross rows (k,)."""
    upper_u, upper_v, height, width = (coordinate[which] for coordinate in edges)
    column: Array = upper_u + (row - upper_v) / height * width
    return column
