"""Which face of a surface each pixel of a picture shows."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.fuser.cycle import around


@dataclass(frozen=True, eq=False)
class Raster:
    """The nearest face of each pixel.

    face : (rows, columns), -1 where there is none. uv : (n, 2) the vertices in the picture, (0, 0) the centre of the
    top-left pixel. faces : (f, 3). nearness : (n,), larger is nearer to the viewer, in mm.
    """

    face: NDArray[np.int32]
    uv: Array
    faces: IntArray
    nearness: Array

    @functools.cached_property
    def pixels(self) -> tuple[IntArray, IntArray]:
        """Rows (p,) and columns (p,) of the pixels that show the surface, in row-major order."""
        rows, columns = np.divmod(np.flatnonzero(self.face >= 0), self.face.shape[1])
        return rows, columns

    def sample(self, values: Array, cycle: float | None = None) -> Array:
        """Values (n,) of the vertices at the shown pixels, linear within each face; (p,) in row-major order.

        Values that repeat after ``cycle`` are taken by the shorter way round from corner to corner, and answered from the
        least of them on.
        """
        v, u = self.pixels
        sampled = self._inside(self.face[v, u], np.stack([u, v], axis=1).astype(np.float64), values, cycle)
        return sampled if cycle is None else values.min() + (sampled - values.min()) % cycle

    def visible(self, uv: Array, nearness: Array, tolerance_mm: float = 1.5) -> BoolArray:
        """Whether points (k, 2) at their nearness (k,) are not behind the surface by more than the tolerance."""
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
        # A pixel on the rim of a face seen edge-on must not take a value from far beyond it.
        clipped: Array = np.clip(value, at_corners.min(axis=1)[face], at_corners.max(axis=1)[face])
        return clipped


def rasterise(uv: Array, nearness: Array, faces: IntArray, facing: BoolArray, shape: tuple[int, int]) -> Raster:
    """Paint the facing faces from the farthest to the nearest (painter's algorithm).

    Parameters
    ----------
    uv, nearness : (n, 2), (n,)
        Vertices in the picture, and how near each is to the viewer in mm.
    faces, facing : (f, 3), (f,)
        Triangles, and which of them turn their outer side to the viewer.
    shape : (rows, columns)
    """
    rows, columns = shape
    picture = Image.new("I", (columns, rows), -1)
    draw = ImageDraw.Draw(picture)
    corners = uv[faces]
    in_field = (corners.max(axis=1) >= 0).all(axis=1) & (corners.min(axis=1) <= [columns - 1, rows - 1]).all(axis=1)
    painted = np.flatnonzero(facing & in_field)
    order = painted[np.argsort(nearness[faces[painted]].mean(axis=1), kind="stable")]
    # Pillow cuts coordinates to whole numbers; half a pixel more rounds them.
    for face, triangle in zip(order.tolist(), (corners[order] + 0.5).reshape(-1, 6).tolist(), strict=True):
        draw.polygon(triangle, fill=face)
    return Raster(np.array(picture, dtype=np.int32), uv, faces, nearness)
