"""Straight and circular edges of a collimator or an image intensifier.

They are fitted to the image where the header has no shutter attributes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from fluoromap.contracts import Array, BoolArray
from fluoromap.segmenter.picture.gaussian_blur import gaussian, reduce_by
from fluoromap.segmenter.picture.log_image import Image

_SIZE = 128
_STEEP = 0.12
_LEAST_FALL = 0.3
_SHARE = 0.75
_LEAST_SIDE = 0.2
_LEAST_RIM = 0.35
_LEVER_PX, _STEEP_PX = 3.0, 5.0
"""How far beside an edge its level is measured, and how far a sharp edge is steep."""
_BEHIND_PX, _MOST_BEHIND = 9.0, 0.5
"""How far beyond an edge the penumbra has ended, and the most that its level may be there, as a share of the level inside."""
_BEYOND = 0.7
_MOST_BEYOND = 0.02
_TRIES = 24
_ANGLES, _ACROSS_PX = 90, 2.0
_NEAR_CENTRE = 0.1


def within_collimator(picture: Image) -> BoolArray:
    """Return the pixels inside all collimator edges that the image shows.

    Edges are searched on an image of about 128 pixels, where the logarithm falls steeply. A circle is fitted to the
    steep pixels by position = centre + radius x direction of the fall, which is linear in its three unknowns. A Hough
    transform collects the remaining steep pixels into straight lines. An edge is accepted under three conditions:

    - The level falls by 30 % along three quarters of the edge's bright inner side.
    - The edge covers a fifth of the image (a circle: a third of its rim).
    - Hardly any pixel beyond it is as bright as the pixels inside, and behind the penumbra most have less than half of their level.

    An edge of anatomy is gentler, shorter, or has bright pixels behind it. The spine's is as steep and as long, but the
    spine is less dark than a collimator's blade.

    Parameters
    ----------
    picture : (rows, columns) float32
        Detected intensity with little noise: a median of frames.

    Returns
    -------
    (rows, columns) bool
    """
    factor = max(1, round(min(picture.shape) / _SIZE))
    # Offset corrections and wrong BitsStored give levels below zero.
    small = np.maximum(gaussian(reduce_by(picture, factor), 1.0), np.float32(0))
    rows, columns = small.shape
    inside = np.ones((rows, columns), dtype=np.bool_)
    if min(rows, columns) < 32:
        return np.ones(picture.shape, dtype=np.bool_)
    edges = _Edges(small)
    circle = edges.circle()
    if circle is not None:
        inside &= circle
    for _ in range(_TRIES):
        if not edges.strongest_line(inside):
            break
    whole: BoolArray = np.repeat(np.repeat(inside, factor, axis=0), factor, axis=1)
    return whole[: picture.shape[0], : picture.shape[1]]


class _Edges:
    """Steep pixels of a reduced image, and which of them no edge has used.

    Coordinates count from the centre of the image.
    """

    def __init__(self, small: Image) -> None:
        self.small = small
        rows, columns = small.shape
        self.centre = np.array([(columns - 1) / 2, (rows - 1) / 2])
        self.size = min(rows, columns)
        self.v, self.u = (axis.astype(np.float64) for axis in np.ogrid[0:rows, 0:columns])
        self.u, self.v = self.u - self.centre[0], self.v - self.centre[1]
        logarithm = np.log(small + np.float32(0.02 * np.percentile(small, 95) + 1e-6))
        fall_v, fall_u = (-slope.astype(np.float64) for slope in np.gradient(logarithm))
        steepness = np.hypot(fall_u, fall_v)
        steep_v, steep_u = np.nonzero(steepness > _STEEP)
        self.points = np.stack([steep_u, steep_v], axis=1) - self.centre
        lengths = steepness[steep_v, steep_u][:, None]
        self.directions = np.stack([fall_u[steep_v, steep_u], fall_v[steep_v, steep_u]], axis=1) / lengths
        # The field contains the middle of the image, so that no edge falls towards it.
        self.free = (self.points * self.directions).sum(axis=1) > _NEAR_CENTRE * self.size

    def circle(self) -> BoolArray | None:
        """Return the pixels inside the circular edge, or None where there is none.

        The steep pixels on the edge are marked as used.
        """
        points, directions = self.points[self.free], self.directions[self.free]
        if len(points) < _LEAST_RIM * self.size:
            return None
        weights = np.ones(len(points))
        for _ in range(8):
            total = weights.sum()
            if total < 1.0:
                return None
            mean_point, mean_direction = weights @ points / total, weights @ directions / total
            spread = (weights[:, None] * (directions - mean_direction) ** 2).sum()
            if spread < 1e-3 * total:
                return None
            radius = (weights[:, None] * (directions - mean_direction) * (points - mean_point)).sum() / spread
            centre = mean_point - radius * mean_direction
            misfit = np.linalg.norm(points - centre - radius * directions, axis=1)
            weights = 1.0 / (1.0 + (misfit / _LEVER_PX) ** 2) ** 2
        if not 0.25 * self.size < radius < 0.8 * self.size:
            return None
        count = math.ceil(2 * math.pi * radius)
        angles = np.arange(count) * (2 * math.pi / count)
        rim = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        distance = np.hypot(self.u - centre[0], self.v - centre[1])
        if not self._is_edge(centre + radius * rim, rim, distance > radius + _LEVER_PX, _LEAST_RIM * count):
            return None
        self._claim(np.abs(np.linalg.norm(self.points - centre, axis=1) - radius) < _STEEP_PX)
        within: BoolArray = distance < radius
        return within

    def strongest_line(self, inside: BoolArray) -> bool:
        """Cut ``inside`` at the line with the most free steep pixels.

        The cut needs an edge there. Returns False when no line is left to try.
        """
        points, directions = self.points[self.free], self.directions[self.free]
        if len(points) < _LEAST_SIDE * self.size:
            return False
        turn = 2 * math.pi / _ANGLES
        angle_of = np.rint(np.arctan2(directions[:, 1], directions[:, 0]) / turn).astype(np.int64)
        reach = math.ceil(math.hypot(*self.small.shape) / 2 / _ACROSS_PX) + 2
        votes = np.zeros((_ANGLES, reach))
        for beside in (-1, 0, 1):
            normal = (angle_of + beside) * turn
            across = points[:, 0] * np.cos(normal) + points[:, 1] * np.sin(normal)
            place = np.clip(np.rint(across / _ACROSS_PX).astype(np.int64), 0, reach - 1)
            np.add.at(votes, ((angle_of + beside) % _ANGLES, place), 1.0)
        votes = votes + np.roll(votes, 1, axis=1)
        angle, place = np.unravel_index(int(np.argmax(votes)), votes.shape)
        normal = np.array([math.cos(angle * turn), math.sin(angle * turn)])
        on_line = np.abs(self.points @ normal - (place - 0.5) * _ACROSS_PX) < 1.5 * _ACROSS_PX
        on_line &= (self.directions @ normal > math.cos(2.5 * turn)) & self.free
        if np.count_nonzero(on_line) < _LEAST_SIDE * self.size:
            return False
        middle = self.points[on_line].mean(axis=0)
        # The normal is the direction of least spread, up to its sign.
        fitted = np.linalg.svd(self.points[on_line] - middle, full_matrices=False)[2][1]
        normal = fitted * np.sign(fitted @ normal)
        offset = float(middle @ normal)
        along = np.array([-normal[1], normal[0]])
        steps = np.arange(-self.size, self.size + 1.0)
        beyond = self.u * normal[0] + self.v * normal[1] - offset
        line = offset * normal + steps[:, None] * along
        if self._is_edge(line, normal, beyond > _LEVER_PX, _LEAST_SIDE * self.size):
            inside &= beyond < 0
        self._claim((np.abs(self.points @ normal - offset) < _STEEP_PX) & (self.directions @ normal > 0.7) | on_line)
        return True

    def _claim(self, on_edge: BoolArray) -> None:
        self.free &= ~on_edge

    def _is_edge(self, edge: Array, normals: Array, beyond: BoolArray, least: float) -> bool:
        """Return whether the level falls across ``edge`` (n, 2) and stays low beyond."""
        inner, inner_in_picture = self._levels(edge - _LEVER_PX * normals)
        outer, outer_in_picture = self._levels(edge + _LEVER_PX * normals)
        in_picture = inner_in_picture & outer_in_picture
        falls = in_picture & (inner - outer > _LEAST_FALL * inner)
        if np.count_nonzero(falls) < least:
            return False
        level = float(np.median(inner[falls]))
        bright = in_picture & (inner > 0.5 * level)
        if np.count_nonzero(falls & bright) < max(_SHARE * np.count_nonzero(bright), 0.75 * least):
            return False
        behind, behind_in_picture = self._levels(edge + _BEHIND_PX * normals)
        behind = behind[behind_in_picture & inner_in_picture]
        if behind.size and float(np.median(behind)) > _MOST_BEHIND * level:
            return False
        pixels = self.small[beyond]
        return pixels.size == 0 or float(np.mean(pixels > _BEYOND * level)) < _MOST_BEYOND

    def _levels(self, places: Array) -> tuple[NDArray[np.float32], BoolArray]:
        u, v = (places + self.centre).T
        rows, columns = self.small.shape
        in_picture = (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)
        levels: NDArray[np.float32] = ndimage.map_coordinates(self.small, [v, u], order=1, mode="nearest")
        return levels, in_picture
