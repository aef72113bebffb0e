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

    def sample(self, pixels: IntArray, values: Array, cycle: float | None = None) -> Array:
        """Interpolate values (n,) of the vertices at pixels (p,), linearly within each face.

        Pixels are counted in row-major order; each must show a face. Where values repeat after ``cycle``, the difference
        between two corners is taken by the shorter way around; the result is within one cycle from the smallest value.
        """
        uv = np.stack(np.divmod(pixels, self.face.shape[1])[::-1], axis=1).astype(np.float64)
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
        corners, at_corners = self.uv[self.faces], values[self.faces]
        if cycle is not None:
            first_corner = at_corners[:, :1]
            at_corners = first_corner + around(at_corners - first_corner, cycle)
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        determinant = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        determinant = np.where(np.abs(determinant) < 1e-9, np.inf, determinant)
        rise, climb = at_corners[:, 1] - at_corners[:, 0], at_corners[:, 2] - at_corners[:, 0]
        slope_u = (rise * second[:, 1] - climb * first[:, 1]) / determinant
        slope_v = (climb * first[:, 0] - rise * second[:, 0]) / determinant
        offset = uv - corners[face, 0]
        value = at_corners[face, 0] + slope_u[face] * offset[:, 0] + slope_v[face] * offset[:, 1]
        # A pixel on the rim of a face that is nearly edge-on must not get a value extrapolated far beyond the face.
        low, high = (of(of(*at_corners.T[:2]), at_corners[:, 2]) for of in (np.minimum, np.maximum))
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
    corners = uv[faces]
    # NumPy is slow along an axis of three: each corner is an operand of its own.
    first, second, third = corners.transpose(1, 2, 0)
    (left, upper), (right, lower) = (of(of(first, second), third) for of in (np.minimum, np.maximum))
    in_field = (right >= 0) & (lower >= 0) & (left <= columns - 1) & (upper <= rows - 1)
    front = np.flatnonzero(facing & in_field)
    front = front[np.argsort(nearness[faces[front]].mean(axis=1), kind="stable")]
    # From the top corner down. Both faces of an edge compute the same crossing: no pixel between them is missed or shared.
    order = np.argsort(corners[front, :, 1], axis=1, kind="stable")
    top, middle, bottom = np.take_along_axis(corners[front], order[..., None], axis=1).transpose(1, 0, 2)
    of_triangle, row = _ranges(top[:, 1], bottom[:, 1], rows)
    top, middle, bottom = (np.repeat(corner, of_triangle, axis=0) for corner in (top, middle, bottom))
    below = (row >= middle[:, 1])[:, None]
    long = _crossing(top, bottom, row)
    short = _crossing(np.where(below, middle, top), np.where(below, bottom, middle), row)
    of_row, column = _ranges(np.minimum(long, short), np.maximum(long, short), columns)
    face = np.full(rows * columns, -1, dtype=np.int32)
    # NumPy keeps the last value assigned to a repeated index.
    face[np.repeat(row * columns, of_row) + column] = np.repeat(np.repeat(front.astype(np.int32), of_triangle), of_row)
    return Raster(face.reshape(shape), uv, faces, nearness)


def _ranges(first: Array, last: Array, end: int) -> tuple[IntArray, IntArray]:
    """Return the integers of several ranges, within 0 to ``end``.

    Range k goes from ``first`` (k,) to below ``last`` (k,). The result is the count of each (k,), and all integers.
    """
    start, stop = (np.ceil(np.clip(bound, 0, end)).astype(np.int64) for bound in (first, last))
    count = stop - start
    past = np.cumsum(count)
    return count, np.arange(count.sum()) + np.repeat(stop - past, count)


def _crossing(upper: Array, lower: Array, row: IntArray) -> Array:
    """Return the columns (k,) where the lines from ``upper`` to ``lower`` (k, 2) cross rows (k,)."""
    along = (row - upper[:, 1]) / np.maximum(lower[:, 1] - upper[:, 1], 1e-12)
    column: Array = upper[:, 0] + along * (lower[:, 0] - upper[:, 0])
    return column
