"""A C-arm view as a 3x4 projection matrix, and the paper's three camera models.

World: DICOM patient axes (+X left, +Y back, +Z head), millimetres, origin at the isocentre.
Pixel (u, v): column and row index; (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective camera ``w (u, v, 1)' = M (X, Y, Z, 1)'``, ``w`` being the depth.

    The 12 numbers of ``matrix`` row by row are m1..m12 of the paper's equation (8).

    Parameters
    ----------
    matrix : array_like, shape (3, 4)
        Scaled at construction so that its third row's first three numbers have length 1: then ``w`` is the depth
        along the central ray, in mm, and positive in front of the source. A C-arm view seen from the detector has a
        left-handed rotation block (determinant -1); either handedness is legal.
    rows, columns : int
        Size of the stored image, for drawing and for the limits of the field.
    isocentre_world_mm : array_like, shape (3,)
        Place of the isocentre: the gantry turns about it. It is the origin unless the world was displaced.

    Raises
    ------
    ValueError
        When the matrix is not 3x4, is not finite or has no centre of projection.
    """

    matrix: Array
    rows: int
    columns: int
    isocentre_world_mm: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        isocentre = np.array(self.isocentre_world_mm, dtype=np.float64)
        if isocentre.shape != (3,) or not np.isfinite(isocentre).all():
            raise ValueError("the isocentre is not a finite point; give three numbers in mm")
        isocentre.setflags(write=False)
        object.__setattr__(self, "isocentre_world_mm", isocentre)
        matrix = np.array(self.matrix, dtype=np.float64)
        if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
            raise ValueError("a camera is a finite 3x4 matrix")
        if abs(np.linalg.det(matrix[:, :3])) < 1e-12:
            raise ValueError("the camera matrix has no centre of projection")
        if self.rows < 1 or self.columns < 1:
            raise ValueError("a camera needs an image of at least one pixel")
        matrix /= np.linalg.norm(matrix[2, :3])
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @property
    def source_world_mm(self) -> Array:
        """Centre of projection (the X-ray source), shape (3,)."""
        source: Array = np.asarray(np.linalg.solve(self.matrix[:, :3], -self.matrix[:, 3]), dtype=np.float64)
        return source

    @property
    def axis_world(self) -> Array:
        """Unit vector of the central ray, from the source to the detector, shape (3,)."""
        return self.matrix[2, :3].copy()

    @property
    def px_per_mm(self) -> float:
        """Pixels per millimetre at the isocentre, mean of the two image directions."""
        jacobian = self.jacobian(np.zeros(3))
        return float(np.sqrt(np.linalg.norm(jacobian[0]) * np.linalg.norm(jacobian[1])))

    def depth_mm(self, points_world_mm: ArrayLike) -> Array:
        """Return the depth of points along the central ray, from the source.

        points_world_mm : ``(..., 3)``. The result has shape (...).
        """
        points = np.asarray(points_world_mm, dtype=np.float64)
        depth: Array = points @ self.matrix[2, :3] + self.matrix[2, 3]
        return depth

    def project(self, points_world_mm: ArrayLike) -> Array:
        """Project points to pixels: full perspective, eq. (1) of the paper.

        points_world_mm : ``(..., 3)``. The result has shape (..., 2).
        """
        points = np.asarray(points_world_mm, dtype=np.float64)
        homogeneous = points @ self.matrix[:, :3].T + self.matrix[:, 3]
        pixels: Array = homogeneous[..., :2] / homogeneous[..., 2:]
        return pixels

    def project_parallel(self, points_world_mm: ArrayLike) -> Array:
        """Project in parallel, eq. (2) of the paper.

        Every point has the scale of the isocentre; there is no depth.
        """
        return self._project_at_depth(points_world_mm, self.matrix[2, 3])

    def project_weak(self, points_world_mm: ArrayLike) -> Array:
        """Project by weak perspective, eq. (3) of the paper.

        Every point has the depth of the cloud's centroid.
        """
        points = np.asarray(points_world_mm, dtype=np.float64)
        return self._project_at_depth(points, float(self.depth_mm(points.reshape(-1, 3).mean(axis=0))))

    def _project_at_depth(self, points_world_mm: ArrayLike, depth_mm: float) -> Array:
        points = np.asarray(points_world_mm, dtype=np.float64)
        principal = self.principal_point_uv
        # Without their share of the depth the two image rows are lengths across the central ray, times focal length.
        across = self.matrix[:2] - principal[:, None] * self.matrix[2]
        pixels: Array = (points @ across[:, :3].T + across[:, 3]) / depth_mm + principal
        return pixels

    @property
    def principal_point_uv(self) -> Array:
        """Pixel of the central ray, shape (2,)."""
        axis = self.matrix[2, :3]
        principal: Array = self.matrix[:2, :3] @ axis
        return principal

    def jacobian(self, points_world_mm: ArrayLike) -> Array:
        """Return the derivative d(u, v)/d(X, Y, Z) at points, px/mm.

        points_world_mm : ``(..., 3)``. The result has shape (..., 2, 3).
        """
        points = np.asarray(points_world_mm, dtype=np.float64)
        pixels = self.project(points)
        depth = self.depth_mm(points)
        rows = self.matrix[:2, :3] - pixels[..., :, None] * self.matrix[2, :3]
        scaled: Array = rows / depth[..., None, None]
        return scaled

    def rays(self, pixels_uv: ArrayLike) -> Array:
        """Return unit directions from the source through pixels, in the world.

        pixels_uv : ``(..., 2)``. The result has shape (..., 3).
        """
        pixels = np.asarray(pixels_uv, dtype=np.float64)
        homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1)
        directions = homogeneous @ np.linalg.inv(self.matrix[:, :3]).T
        unit: Array = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        return unit

    def back_project(self, pixels_uv: ArrayLike, depth_mm: ArrayLike) -> Array:
        """Return the points on the rays of pixels at these depths, shape (..., 3).

        pixels_uv : ``(..., 2)``. depth_mm : ``(...)``, along the central ray.
        """
        directions = self.rays(pixels_uv)
        along = directions @ self.matrix[2, :3]
        points: Array = self.source_world_mm + directions * (np.asarray(depth_mm, dtype=np.float64) / along)[..., None]
        return points

    def translated(self, shift_world_mm: ArrayLike) -> Camera:
        """Return the camera for coordinates with another origin.

        The new origin lies at ``shift_world_mm`` in this camera's world. For a run on a moved table, the shift is the
        table's displacement: the coordinates then belong to the patient, and all runs share them.
        """
        shift = np.asarray(shift_world_mm, dtype=np.float64)
        matrix = self.matrix.copy()
        matrix[:, 3] += matrix[:, :3] @ shift
        return Camera(matrix, self.rows, self.columns, self.isocentre_world_mm - shift)

    def displaced(self, displacement: ArrayLike) -> Camera:
        """Return the camera of a view that sees the world displaced by ``displacement`` (4, 4) about the isocentre."""
        about = np.eye(4)
        about[:3, 3] = self.isocentre_world_mm
        back = np.eye(4)
        back[:3, 3] = -self.isocentre_world_mm
        return replace(self, matrix=self.matrix @ about @ np.asarray(displacement, dtype=np.float64) @ back)


def ray_angle_deg(first: Camera, second: Camera) -> float:
    """Return the angle between two views' central rays, folded to 0..90 degrees."""
    return direction_angle_deg(first.axis_world, second.axis_world)


def direction_angle_deg(first: ArrayLike, second: ArrayLike) -> float:
    """Return the angle between two rays, folded to 0..90 degrees.

    Parameters
    ----------
    first, second : array_like, shape (3,)
        Unit vectors in the same frame.
    """
    cosine = abs(float(np.dot(first, second)))
    return float(np.degrees(np.arccos(min(cosine, 1.0))))
