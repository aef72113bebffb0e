"""Compiled drawing: strokes, metal bands and discs added to an image of attenuation.

Images are (rows, columns) float32 in log units, positive where X-rays are absorbed. Places are (u, v) pixels; the centre of the
first pixel is (0, 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fluoromap.contracts import Array

Image = NDArray[np.float32]

_THIN_PX = 1.2
_FINEST_PX = 0.4
_FAR = np.float32(9.0)


@dataclass(slots=True, eq=False)
class Canvas:
    """Attenuation of the things in one scene, (size, size) log units, and two images of work space."""

    depth: Image
    _nearest: Image
    _strength: Image

    @classmethod
    def empty(cls, size: int) -> Canvas:
        """Return a canvas with nothing on it."""
        return cls(
            np.zeros((size, size), np.float32),
            np.full((size, size), _FAR, np.float32),
            np.zeros((size, size), np.float32),
        )

    @property
    def size(self) -> int:
        return int(self.depth.shape[0])

    def stroke(
        self,
        points_uv: Array,
        radius_px: Array | float,
        strength: Array | float,
        hollow: float = 0.0,
        flat: bool = False,
    ) -> None:
        """Add a tube along a polyline.

        Parameters
        ----------
        points_uv : (n, 2)
        radius_px, strength : (n,) or float
            Outer radius and attenuation through the middle of a solid tube.
        hollow : float
            Inner radius over outer radius; 0 is solid.
        flat : bool
            Whether the attenuation is the same across the whole width, as of a ribbon.
        """
        count = len(points_uv)
        if count < 2:
            return
        radius = np.ascontiguousarray(np.broadcast_to(np.asarray(radius_px, np.float64), count))
        values = np.ascontiguousarray(np.broadcast_to(np.asarray(strength, np.float64), count))
        _stroke(
            self.depth, self._nearest, self._strength, np.ascontiguousarray(points_uv, dtype=np.float64), radius, values,
            float(hollow), bool(flat),
        )  # fmt: skip

    def band(
        self, at_uv: Array, angle: float, half_px: float, radius_px: float, strength: float, hollow: float, dome: bool,
        edge_px: float,
    ) -> None:  # fmt: skip
        """Add a metal band.

        It is a short tube with square ends along the direction ``angle``; ``dome`` rounds the forward end.
        """
        _band(
            self.depth, float(at_uv[0]), float(at_uv[1]), angle, max(half_px, 0.2), max(radius_px, 0.3), strength, hollow, dome,
            edge_px,
        )  # fmt: skip

    def ring(
        self,
        at_uv: Array,
        angle: float,
        half_px: float,
        radius_px: float,
        strength: float,
        hollow: float,
        shortening: float,
    ) -> None:
        """Add a thin-walled ring that is seen obliquely: both its openings show.

        Parameters
        ----------
        at_uv : (2,)
        angle : float
            Direction of its axis in the image.
        half_px, radius_px : float
            Half its length and its outer radius in space.
        strength : float
            Attenuation where a ray touches the inside of a ring that lies in the image plane.
        hollow : float
            Inner radius over outer radius, above 0.
        shortening : float
            Length seen over length in space, above 0 and below 1.
        """
        _ring(self.depth, float(at_uv[0]), float(at_uv[1]), angle, half_px, radius_px, strength, hollow, shortening)

    def disc(
        self, at_uv: Array, half_u: float, half_v: float, angle: float, strength: float, edge_px: float, power: float
    ) -> None:
        """Add a filled ellipse.

        ``power`` 2 is an ellipse, a larger one a box with rounded corners.
        """
        _disc(self.depth, float(at_uv[0]), float(at_uv[1]), half_u, half_v, angle, strength, edge_px, power)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _stroke(depth, nearest, strengths, points, radius, strength, hollow, flat):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the line's depth into the pixels.

    Every pixel takes the nearest piece of the line only, so that bends are not counted twice.
    """
    rows, columns = depth.shape
    left, right, top, bottom = columns, -1, rows, -1
    for k in range(points.shape[0] - 1):
        u0, v0, u1, v1 = points[k, 0], points[k, 1], points[k + 1, 0], points[k + 1, 1]
        reach = max(radius[k], radius[k + 1]) + 2.0
        first_u, last_u = max(int(min(u0, u1) - reach), 0), min(int(max(u0, u1) + reach) + 1, columns - 1)
        first_v, last_v = max(int(min(v0, v1) - reach), 0), min(int(max(v0, v1) + reach) + 1, rows - 1)
        if first_u > last_u or first_v > last_v:
            continue
        left, right, top, bottom = min(left, first_u), max(right, last_u), min(top, first_v), max(bottom, last_v)
        du, dv = u1 - u0, v1 - v0
        square = max(du * du + dv * dv, 1e-9)
        for v in range(first_v, last_v + 1):
            for u in range(first_u, last_u + 1):
                share = min(max(((u - u0) * du + (v - v0) * dv) / square, 0.0), 1.0)
                au, av = u - u0 - share * du, v - v0 - share * dv
                r = radius[k] + share * (radius[k + 1] - radius[k])
                away = math.sqrt(au * au + av * av)
                value = strength[k] + share * (strength[k + 1] - strength[k])
                if r < _THIN_PX and not flat:
                    # A Gaussian of the tube's own area: a thin line drawn by its outline would flicker between pixels.
                    sigma = math.sqrt(0.25 * r * r + _FINEST_PX * _FINEST_PX)
                    q = away / (3.0 * sigma)
                    value *= 0.5 * math.pi * r / (2.5066 * sigma)
                else:
                    q = away / max(r, 0.7)
                if q < nearest[v, u]:
                    nearest[v, u] = q
                    strengths[v, u] = value
    thin = not flat and radius[0] < _THIN_PX
    rim = math.sqrt(1.0 - hollow * hollow)
    soft = 0.5 / max(radius[0], 0.7)
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            q = nearest[v, u]
            if q < 1.6:
                if thin:
                    profile = math.exp(-4.5 * q * q)
                elif flat:
                    profile = min(max((1.0 - q) / (2.0 * soft) + 0.5, 0.0), 1.0)
                else:
                    profile = math.sqrt(max(1.0 - q * q, 0.0))
                    if hollow > 0.0:
                        profile = (profile - math.sqrt(max(hollow * hollow - q * q, 0.0))) / rim
                depth[v, u] += strengths[v, u] * profile
            nearest[v, u] = _FAR


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _band(depth, at_u, at_v, angle, half, radius, strength, hollow, dome, edge):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = depth.shape
    reach = half + radius + 2.0 * edge + 1.0
    cosine, sine = math.cos(angle), math.sin(angle)
    rim = math.sqrt(1.0 - hollow * hollow)
    for v in range(max(int(at_v - reach), 0), min(int(at_v + reach) + 2, rows)):
        for u in range(max(int(at_u - reach), 0), min(int(at_u + reach) + 2, columns)):
            along = (u - at_u) * cosine + (v - at_v) * sine
            across = abs((v - at_v) * cosine - (u - at_u) * sine) / radius
            beside = min(max((1.0 - across) * radius / edge + 0.5, 0.0), 1.0)
            q = min(across * across, 1.0)
            profile = math.sqrt(1.0 - q)
            end = half
            if dome and along > 0:
                end = half - 0.8 * radius * (1.0 - profile)
            if hollow > 0.0:
                profile = (profile - math.sqrt(max(hollow * hollow - q, 0.0))) / rim
            kept = min(max((end - abs(along)) / edge + 0.5, 0.0), 1.0)
            depth[v, u] += strength * profile * kept * beside


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _ring(depth, at_u, at_v, angle, half, radius, strength, hollow, shortening):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the length of each ray within the wall.

    At the place p square to the axis in the plane of ray and axis, a ray that passes the middle at ``along`` is at
    (along + p * tilt) / shortening on the axis. The wall is where p lies between the inner and the outer circle.
    """
    rows, columns = depth.shape
    tilt = math.sqrt(1.0 - shortening * shortening)
    reach = half * shortening + radius + 1.0
    cosine, sine = math.cos(angle), math.sin(angle)
    inner = hollow * radius
    scale = strength / (8.0 * math.sqrt(radius * radius - inner * inner) * shortening)
    for v in range(max(int(at_v - reach), 0), min(int(at_v + reach) + 2, rows)):
        for u in range(max(int(at_u - reach), 0), min(int(at_u + reach) + 2, columns)):
            length = 0.0
            for quarter in range(4):
                du, dv = u - at_u + 0.5 * (quarter % 2) - 0.25, v - at_v + 0.5 * (quarter // 2) - 0.25
                along, across = du * cosine + dv * sine, dv * cosine - du * sine
                outside = radius * radius - across * across
                if outside <= 0.0:
                    continue
                far, near = math.sqrt(outside), math.sqrt(max(inner * inner - across * across, 0.0))
                first, last = (-half * shortening - along) / tilt, (half * shortening - along) / tilt
                length += max(min(last, far) - max(first, near), 0.0) + max(min(last, -near) - max(first, -far), 0.0)
            depth[v, u] += scale * length


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _disc(depth, at_u, at_v, half_u, half_v, angle, strength, edge, power):  # type: ignore[no-untyped-def]  # pragma: no cover
    rows, columns = depth.shape
    reach = 1.5 * max(half_u, half_v) + 2.0 * edge + 1.0
    cosine, sine = math.cos(angle), math.sin(angle)
    least = min(half_u, half_v)
    for v in range(max(int(at_v - reach), 0), min(int(at_v + reach) + 2, rows)):
        for u in range(max(int(at_u - reach), 0), min(int(at_u + reach) + 2, columns)):
            a = abs((u - at_u) * cosine + (v - at_v) * sine) / half_u
            b = abs((v - at_v) * cosine - (u - at_u) * sine) / half_v
            q = (a**power + b**power) ** (1.0 / power)
            depth[v, u] += strength * min(max((1.0 - q) * least / edge + 0.5, 0.0), 1.0)
