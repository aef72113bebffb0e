"""Geometry of two views: the epipolar constraint and the paper's four projection equations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fluoromap.contracts import Array
from fluoromap.geometry import Camera

PARALLEL_BELOW_DEG = 20.0 - 1e-6
"""Views whose central rays are closer than 20 degrees give no depth; the tolerance lets 20 degrees count as 20 degrees."""


def fundamental_matrix(camera_a: Camera, camera_b: Camera) -> Array:
    """Return the fundamental matrix F of two views, (3, 3).

    For one point in both views ``(u_b, v_b, 1) F (u_a, v_a, 1)' = 0``.

    References
    ----------
    Hartley & Zisserman, Multiple View Geometry, 2nd ed., eq. (9.1): ``F = [e_b]x M_b M_a^+``.
    """
    e1, e2, e3 = camera_b.matrix @ np.append(camera_a.source_world_mm, 1.0)
    cross = np.array([[0.0, -e3, e2], [e3, 0.0, -e1], [-e2, e1, 0.0]])
    fundamental: Array = cross @ camera_b.matrix @ np.linalg.pinv(camera_a.matrix)
    return fundamental


def signed_epipolar_px(camera_a: Camera, camera_b: Camera, pixels_a: ArrayLike, pixels_b: ArrayLike) -> Array:
    """Return each point's signed distance in view b from its epipolar line.

    Parameters
    ----------
    camera_a, camera_b : Camera
    pixels_a, pixels_b : array_like, shape (..., 2)
        The same electrodes (u, v) in the two views.

    Returns
    -------
    ndarray, shape (...)
        Pixels of view b; the sign is the same for the same direction across the lines.
    """
    fundamental = fundamental_matrix(camera_a, camera_b)
    a, b = np.asarray(pixels_a, dtype=np.float64), np.asarray(pixels_b, dtype=np.float64)
    lines = a @ fundamental[:, :2].T + fundamental[:, 2]
    distances: Array = ((lines[..., :2] * b).sum(axis=-1) + lines[..., 2]) / np.hypot(lines[..., 0], lines[..., 1])
    return distances


def triangulate_linear(camera_a: Camera, camera_b: Camera, pixels_a: ArrayLike, pixels_b: ArrayLike) -> Array:
    """Triangulate points by linear least squares of the paper's equations (8).

    Each view gives ``(u m_3 - m_1) X = m_14 - u m_34`` and the same for v: four equations, three unknowns.

    Parameters
    ----------
    camera_a, camera_b : Camera
    pixels_a, pixels_b : array_like, shape (N, 2)
        The same N electrodes (u, v) in the two views.

    Returns
    -------
    ndarray, shape (N, 3)
        World, mm.

    Raises
    ------
    numpy.linalg.LinAlgError
        When the views coincide.
    """
    rows = []
    for camera, pixels in ((camera_a, pixels_a), (camera_b, pixels_b)):
        uv = np.asarray(pixels, dtype=np.float64)
        for coordinate, row in zip(uv.T, camera.matrix[:2], strict=True):
            rows.append(coordinate * camera.matrix[2, :, None] - row[:, None])
    equations = np.stack(rows, axis=1)
    return _least_squares(list(equations[:3]), -equations[3]).T


def _least_squares(columns: list[Array], known: Array) -> Array:
    """Return the unknowns (3, n) of n systems of four equations.

    The modified Gram-Schmidt process makes triangular systems of them. It keeps the condition number of the equations; normal
    equations would square it at small angles.

    Parameters
    ----------
    columns : three of (4, n)
        Factors of each unknown.
    known : (4, n)
        Right sides.
    """
    factors: list[list[Array]] = []
    for number in range(3):
        length = np.sqrt((columns[number] ** 2).sum(axis=0))
        if not length.all():
            raise np.linalg.LinAlgError("the views coincide")
        unit = columns[number] / length
        later = [(unit * other).sum(axis=0) for other in (*columns[number + 1 :], known)]
        factors.append([length, *later])
        columns = [
            other if place <= number else other - later[place - number - 1] * unit
            for place, other in enumerate(columns)
        ]
        known = known - later[-1] * unit
    (r11, r12, r13, z1), (r22, r23, z2), (r33, z3) = factors
    z = z3 / r33
    y = (z2 - r23 * z) / r22
    return np.stack([(z1 - r12 * y - r13 * z) / r11, y, z])
