"""Fit of all electrodes of a found chain at once, as pictures of cylinders along its line.

So the image says where they are (:func:`fit_cylinders`), and of which catheter and in which order (:func:`compare_catheters`).

A ring that is seen obliquely is dark at both ends of its openings and bright in its middle, and the openings of a pair meet. So a
dark place is no electrode's middle, and no electrode can be fitted without its neighbours. Electrodes along a line overlap their
neighbours at most: the best places of all of them are found by dynamic programming.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import uniform_filter1d

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, BoolArray, IntArray
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.places.cylinder_pictures import STEP_PX, draw_electrode, half_length_px, reached_rows

_Degrees = tuple[tuple[int, int], ...]

_SAMPLES = 9.0
"""Independent samples of an electrode's picture: neighbouring pixels deviate from it alike."""

_SCALES = 1.0, 1.1
"""Sizes that are tried, over the usual one: makers' diameters differ, and a heart may lie nearer to the X-ray source."""
_TUBE, _SOLID = 0.86, 0.0
"""Inner radius of a ring, as a share of its radius: platinum round the shaft, or so much of it that it is as good as solid."""
_CLEARLY = 1.3
"""How many times as much darkness tubes leave unexplained where rings are clearly solid."""
_WIDER = 1.15
"""How far a picture reaches to each side, over the radius: makers' catheters differ."""
_MARGIN_PX, _SIDE_PX, _SIDE_COLUMNS, _SMOOTH_PX = 1.5, 4.0, 3, 6.5
_SHAFT_QUANTILE = 0.2
_FIRST_SD, _LAST_SD = 0.12, 0.06
"""Standard deviation of a gap over its true length, in the first search and in the last."""
_FORESHORTENING, _AS_FOUND = np.array([0.8, 0.9, 1.0, 1.1, 1.2]), np.array([1.0])
"""Tried in the first search, as a share of that of the found places."""
_LAST_REACH_PX = 2.0
_PAST_OPENING_PX = 2.0
_LEAST_COSINE, _MOST_COSINE = 0.12, 1.05
_FITTED, _COMPARED = ((8, 3), (4, 2), (0, 1)), ((6, 2), (0, 1))
"""Least number of electrodes, and the degree of the polynomial of the arc length that they show. Catheters that are compared may
bend less, else a wrong one would bend until it fits."""
_LEAST_GAP, _MEETS = 0.1, 1e3
_ITERATIONS = 3
_COMPARED_PX_PER_MM = 3.5
"""Scale at which catheters are compared where the frame has a larger one: lengths show well enough, in a quarter of the time."""
_FAR, _NOTHING = 1e300, 1e-12
_STAYS = 1e-3
"""Cost of a move by a sample, squared: where the image says nothing, electrodes stay."""
_LEAST_SHARE = 0.02
_DARKEST = 1.2
"""How much darker than the picture an electrode may seem: what is darker is something else."""


@dataclass(frozen=True, slots=True, eq=False)
class CylinderFit:
    """Places of a chain's electrodes.

    points_uv : (electrodes, 2) pixels. log_likelihood : of the image along the chain, less that at the places before. is_solid :
    whether the rings are clearly solid, without openings.
    """

    points_uv: Array
    log_likelihood: float
    is_solid: bool


@dataclass(frozen=True, slots=True, eq=False)
class CatheterComparison:
    """What the image along a chain's line says of catheters with as many electrodes, each in both orders.

    points_uv : (catheters, 2, electrodes, 2) best places from the tip on, pixels; the first order is that of the chain.
    log_likelihood : (catheters, 2), but for a constant.
    """

    points_uv: Array
    log_likelihood: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """The image along a chain's line, straightened.

    places_uv : (samples, 2) of the line, half a pixel of the strip apart. strip : (samples, columns) darkness, log units; the
    middle column is on the line. at : (electrodes,) index of the sample nearest to each electrode. arc_px : (electrodes,) length of
    the line up to each.
    """

    places_uv: Array
    strip: Array
    at: IntArray
    arc_px: Array

    def places_at(self, moved_px: Array) -> Array:
        """Return where electrodes are that moved so far along the line, (electrodes, 2)."""
        at, samples = self.at + moved_px / STEP_PX, np.arange(len(self.strip))
        places: Array = np.stack([np.interp(at, samples, self.places_uv[:, axis]) for axis in range(2)], axis=1)
        return places

    def turned(self) -> _Line:
        """Return the line from its other end on."""
        last = len(self.strip) - 1
        return _Line(
            self.places_uv[::-1],
            np.ascontiguousarray(self.strip[::-1]),
            last - self.at[::-1],
            self.arc_px[-1] - self.arc_px[::-1],
        )


def fit_cylinders(
    image: Image, chain_uv: Array, catheter: Catheter, px_per_mm: float, radius_mm: float, stays: BoolArray
) -> CylinderFit:
    """Fit a found chain of three or more electrodes as cylinders.

    Rings are tubes or solid, and of the usual size or larger, as explains the image best. Electrodes move along the chain's line;
    their gaps are those of the catheter, whose foreshortening changes little from one to the next.

    Parameters
    ----------
    image : (rows, columns) float32
        Log image.
    chain_uv : (electrodes, 2)
        Found places from the tip on, pixels.
    catheter : Catheter
    px_per_mm : float
        At the isocentre.
    radius_mm : float
        Usual radius of such a catheter.
    stays : (electrodes,)
        Electrodes that keep their places, because something else is seen there.
    """
    shapes = [_shape(catheter, by * px_per_mm, by * radius_mm * px_per_mm) for by in _SCALES]
    reach = max(_first_reach(shape) for shape in shapes)
    line = _straighten(image, chain_uv, shapes, reach)

    def search(shape: _Shape, inner: float) -> tuple[float, Array]:
        return _search_along(line, shape, inner, stays, reach, _FIRST_SD, _FORESHORTENING)

    usual, *larger = shapes
    tried = {(usual, inner): search(usual, inner) for inner in (_TUBE, _SOLID)}
    _, inner = min(tried, key=lambda kind: tried[kind][0])
    is_solid = tried[usual, _TUBE][0] > _CLEARLY * tried[usual, _SOLID][0]
    tried |= {(shape, inner): search(shape, inner) for shape in larger}
    shape, inner = min(tried, key=lambda kind: tried[kind][0])
    before, _ = _search_along(line, shape, inner, stays, 0, _FIRST_SD, _AS_FOUND)
    nearer = np.where(stays[:, None], chain_uv, line.places_at(tried[shape, inner][1]))
    reach = int(_LAST_REACH_PX / STEP_PX)
    line = _straighten(image, nearer, (shape,), reach)
    after, moved_px = _search_along(line, shape, inner, stays, reach, _LAST_SD, _AS_FOUND)
    points = np.where(stays[:, None], chain_uv, line.places_at(moved_px))
    gain = 0.5 * _SAMPLES * len(points) * math.log(max(before, _LEAST_SHARE) / max(after, _LEAST_SHARE))
    return CylinderFit(points, gain, is_solid)


def compare_catheters(
    image: Image,
    chain_uv: Array,
    catheters: Sequence[Catheter],
    px_per_mm: float,
    radii_mm: Sequence[float],
    unseen: BoolArray,
) -> CatheterComparison:
    """Compare catheters along the line of a chain, from each of its ends.

    Every one is fitted to the same strip of the image, so that what each leaves unexplained can be compared. Rings are tubes here:
    as solid ones they would look like short tips.

    Parameters
    ----------
    image : (rows, columns) float32
        Log image.
    chain_uv : (electrodes, 2)
        Found places, pixels.
    catheters : sequence of Catheter
        All have as many electrodes as the chain.
    px_per_mm : float
        At the isocentre.
    radii_mm : sequence of float
        Usual radius of each catheter.
    unseen : (electrodes,)
        Electrodes of which the image says nothing.
    """
    pitch_px = max(px_per_mm / _COMPARED_PX_PER_MM, 1.0)
    scale = px_per_mm / pitch_px
    shapes = [_shape(catheter, scale, radius * scale) for catheter, radius in zip(catheters, radii_mm, strict=True)]
    reach = max(_first_reach(shape) for shape in shapes)
    strip = _straighten(image, chain_uv, shapes, reach, pitch_px)
    points = np.empty((len(shapes), 2, *chain_uv.shape))
    left = np.empty((len(shapes), 2))
    both_ways = (strip, unseen), (strip.turned(), unseen[::-1].copy())
    for order, (line, stays) in enumerate(both_ways):
        for index, shape in enumerate(shapes):
            left[index, order], moved_px = _search_along(
                line, shape, _TUBE, stays, reach, _FIRST_SD, _FORESHORTENING, _COMPARED
            )
            points[index, order] = line.places_at(moved_px)
    drawn = np.count_nonzero(~unseen)
    return CatheterComparison(points, -0.5 * _SAMPLES * drawn * np.log(np.maximum(left, _LEAST_SHARE)))


@dataclass(frozen=True, eq=False)
class _Shape:
    """Lengths of a catheter in pixels."""

    catheter: Catheter
    px_per_mm: float
    radius_px: float

    @functools.cached_property
    def half_px(self) -> Array:
        """Half the lengths of the electrodes, (electrodes,)."""
        half = np.full(self.catheter.electrodes, 0.5 * self.catheter.ring_mm * self.px_per_mm)
        half[0] = 0.5 * self.catheter.tip_mm * self.px_per_mm
        return half

    @functools.cached_property
    def longest_half_px(self) -> float:
        return float(self.half_px.max())

    @functools.cached_property
    def spacing_px(self) -> Array:
        return np.array(self.catheter.spacing_mm) * self.px_per_mm

    @property
    def columns(self) -> int:
        """How far to each side of the line a picture reaches, pixels."""
        return int(_WIDER * self.radius_px + _MARGIN_PX)


@functools.lru_cache(maxsize=64)
def _shape(catheter: Catheter, px_per_mm: float, radius_px: float) -> _Shape:
    return _Shape(catheter, px_per_mm, radius_px)


def _first_reach(shape: _Shape) -> int:
    """Return how many samples an electrode may be from its found place.

    That is past one of its openings.
    """
    return int((shape.radius_px + _PAST_OPENING_PX) / STEP_PX)


def _straighten(image: Image, points_uv: Array, shapes: Sequence[_Shape], reach: int, pitch_px: float = 1.0) -> _Line:
    """Sample the image along a chain, without the anatomy beside it and without the shaft.

    ``shapes`` : all for which the strip must be long and wide enough. ``pitch_px`` : pixels of the frame in one of the strip, in
    which all lengths are.
    """
    points_uv = points_uv / pitch_px
    columns = max(one.columns for one in shapes)
    longest = max(one.longest_half_px for one in shapes)
    steps = np.diff(points_uv, axis=0)
    arc = np.concatenate([[0.0], np.cumsum(np.sqrt((steps * steps).sum(axis=1)))])
    axes = np.concatenate([steps[:1], points_uv[2:] - points_uv[:-2], steps[-1:]])
    axes = axes / np.maximum(np.sqrt((axes * axes).sum(axis=1, keepdims=True)), 1e-9)
    ends = longest + columns + _MARGIN_PX + (reach + 1) * STEP_PX
    along = np.arange(-ends, arc[-1] + ends, STEP_PX)
    beyond = np.minimum(along, 0.0)[:, None] * axes[0] + np.maximum(along - arc[-1], 0.0)[:, None] * axes[-1]
    places = np.stack([np.interp(along, arc, points_uv[:, axis]) for axis in range(2)], axis=1) + beyond
    tangents = np.stack([np.interp(along, arc, axes[:, axis]) for axis in range(2)], axis=1)
    tangents /= np.maximum(np.sqrt((tangents * tangents).sum(axis=1, keepdims=True)), 1e-9)
    wide = int(_WIDER * max(one.radius_px for one in shapes) + _SIDE_PX)
    strip = np.empty((len(along), 2 * wide + 1))
    _sample_strip(image, places, tangents, pitch_px, strip)
    sides = 0.5 * (strip[:, :_SIDE_COLUMNS].mean(axis=1) + strip[:, -_SIDE_COLUMNS:].mean(axis=1))
    strip -= uniform_filter1d(sides, 2 * int(_SMOOTH_PX / STEP_PX / 2) + 1, mode="nearest")[:, None]
    brightest = int(_SHAFT_QUANTILE * len(strip))
    strip -= np.partition(strip, brightest, axis=0)[brightest]
    strip = np.ascontiguousarray(strip[:, wide - columns : wide + columns + 1])
    at = np.rint((arc + ends) / STEP_PX).astype(np.int64)
    return _Line(pitch_px * places, strip, at, arc)


def _foreshortening(arc_px: Array, shape: _Shape, degrees: _Degrees) -> tuple[Array, Array]:
    """Return the visible over the true length at the electrodes, (electrodes,), and of the gaps, (electrodes - 1,).

    It changes smoothly along a catheter, and places that are wrong by an opening hardly change it. Seen obliquely, a loop is an
    ellipse: the square changes with twice the angle on the loop.
    """
    smooth = _smoothing(shape.catheter, degrees)
    if shape.catheter.is_circular:
        cosine = np.sqrt(np.maximum(smooth @ (np.diff(arc_px) / shape.spacing_px) ** 2, 0.0))
    else:
        cosine = smooth @ arc_px / shape.px_per_mm
    count = len(arc_px)
    bounded = np.maximum(cosine, _LEAST_COSINE)
    return np.minimum(bounded[:count], 1.0), np.minimum(bounded[count:], _MOST_COSINE)


@functools.lru_cache(maxsize=64)
def _smoothing(catheter: Catheter, degrees: _Degrees) -> Array:
    """Return the matrix of the smooth foreshortening at electrodes, then gaps.

    Its columns are those of visible arc lengths, or of the squares of a loop's gaps.
    """
    arc_mm = catheter.arc_lengths_mm
    middles = 0.5 * (arc_mm[1:] + arc_mm[:-1])
    places = np.concatenate([arc_mm, middles])
    if catheter.is_circular:
        known, wanted = (_with_twice(catheter.curvature_per_mm * where) for where in (middles, places))
        squares: Array = wanted @ np.linalg.pinv(known)
        return squares
    degree = next(degree for least, degree in degrees if len(arc_mm) >= least)
    slopes = np.stack([power * places ** max(power - 1, 0) for power in range(degree + 1)], axis=1)
    matrix: Array = slopes @ np.linalg.pinv(np.vander(arc_mm, degree + 1, increasing=True))
    return matrix


def _with_twice(angles_rad: Array) -> Array:
    return np.stack([np.ones(len(angles_rad)), np.cos(2.0 * angles_rad), np.sin(2.0 * angles_rad)], axis=1)


def _search_along(
    line: _Line,
    shape: _Shape,
    inner: float,
    stays: BoolArray,
    reach: int,
    spacing_sd: float,
    shares: Array,
    degrees: _Degrees = _FITTED,
) -> tuple[float, Array]:
    """Search the electrodes along a line.

    Returns the share of its darkness that they leave unexplained, and how far they move, (electrodes,) pixels.

    inner : see :func:`~fluoromap.segmenter.places.cylinder_pictures.draw_electrode`.
    """
    cosine, gap_cosine = _foreshortening(line.arc_px, shape, degrees)
    size = int((half_length_px(shape.half_px, shape.radius_px, cosine).max() + _MARGIN_PX) / STEP_PX)
    moved = np.zeros(len(line.at))
    share = _search(
        line.strip, line.at, shape.half_px, cosine, gap_cosine, shape.spacing_px, shape.radius_px, inner, stays, reach,
        spacing_sd, shares, size, moved,
    )  # fmt: skip
    return share, moved


@kernel("f4[:,::1], f8[:,::1], f8[:,::1], f8, f8[:,::1]")
def _sample_strip(x, places, tangents, pitch, strip):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the darkness beside each place of a line."""
    last_u, last_v = x.shape[1] - 1.001, x.shape[0] - 1.001
    wide = strip.shape[1] // 2
    for row in range(strip.shape[0]):
        for column in range(strip.shape[1]):
            w = column - wide
            u = min(max(pitch * (places[row, 0] - w * tangents[row, 1]), 0.0), last_u)
            v = min(max(pitch * (places[row, 1] + w * tangents[row, 0]), 0.0), last_v)
            left, top = int(u), int(v)
            f, g = u - left, v - top
            upper = x[top, left] + f * (x[top, left + 1] - x[top, left])
            lower = x[top + 1, left] + f * (x[top + 1, left + 1] - x[top + 1, left])
            strip[row, column] = -(upper + g * (lower - upper))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _compare(strip, at, half, cosine, radius, inner, stays, reach, size, strength, seen, both):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the scalar products of the electrodes' pictures.

    strength : (electrodes,) with themselves. seen : (electrodes, choices) with the strip at each place. both : (electrodes,
    2 choices - 1) with the picture of the electrode before, at each distance.
    """
    count, choices, columns = at.size, seen.shape[1], strip.shape[1]
    pictures = np.zeros((count, 2 * size + 1, columns))
    # Rows of a picture before and after its middle that are not empty.
    rows = np.zeros(count, np.int64)
    for k in range(count):
        if stays[k]:
            continue
        draw_electrode(pictures[k], half[k], radius, inner, k == 0, cosine[k])
        rows[k] = min(reached_rows(half[k], radius, cosine[k]), size)
        for row in range(size - rows[k], size + rows[k] + 1):
            for column in range(columns):
                strength[k] += pictures[k, row, column] * pictures[k, row, column]
        for choice in range(choices):
            first = at[k] + choice - reach - size
            for row in range(max(-first, size - rows[k]), min(size + rows[k] + 1, strip.shape[0] - first)):
                for column in range(columns):
                    seen[k, choice] += strip[first + row, column] * pictures[k, row, column]
    for k in range(1, count):
        if stays[k] or stays[k - 1]:
            continue
        for way in range(2 * choices - 1):
            apart = at[k] - at[k - 1] + way - 2 * reach
            top, bottom = (
                max(size - rows[k], size - rows[k - 1] - apart),
                min(size + rows[k], size + rows[k - 1] - apart),
            )
            for row in range(top, bottom + 1):
                for column in range(columns):
                    both[k, way] += pictures[k - 1, row + apart, column] * pictures[k, row, column]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _choose(at, gap_cosine, spacing, spacing_sd, shares, reach, weight, depth, strength, seen, both, chosen):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the place of each electrode that makes the whole chain most likely.

    By dynamic programming along the chain, for each foreshortening. weight : of the squared darkness that is left.
    """
    count, choices = seen.shape
    before = np.zeros((count, choices), np.int64)
    total, costs = np.zeros(choices), np.zeros(choices)
    least = _FAR
    for number in range(shares.size):
        share = shares[number]
        for k in range(count):
            for choice in range(choices):
                best, arg = 0.0, 0
                if k > 0:
                    best = _FAR
                    for other in range(choices):
                        gap = (at[k] + choice - at[k - 1] - other) * STEP_PX / spacing[k - 1]
                        away = (gap - share * gap_cosine[k - 1]) / spacing_sd
                        cost = total[other] + 0.5 * away * away
                        cost += weight * 2.0 * depth[k] * depth[k - 1] * both[k, choice - other + 2 * reach]
                        if gap < _LEAST_GAP:
                            cost += _MEETS
                        if cost < best:
                            best, arg = cost, other
                own = min(seen[k, choice], _DARKEST * depth[k] * strength[k])
                moved = float(choice - reach)
                costs[choice] = best + _STAYS * moved * moved
                costs[choice] += weight * depth[k] * (depth[k] * strength[k] - 2.0 * own)
                before[k, choice] = arg
            for choice in range(choices):
                total[choice] = costs[choice]
        last = 0
        for choice in range(1, choices):
            if total[choice] < total[last]:
                last = choice
        if total[last] < least:
            least = total[last]
            for k in range(count - 1, -1, -1):
                chosen[k] = last
                last = before[k, last]


@kernel("f8[:,::1], i8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, f8, b1[::1], i8, f8, f8[::1], i8, f8[::1]")
def _search(strip, at, half, cosine, gap_cosine, spacing, radius, inner, stays, reach, spacing_sd, shares, size, moved):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write how far electrodes move along a line, pixels.

    Returns the share of its darkness that they leave unexplained.

    With pictures of one depth for all rings and one for the tip, the unexplained darkness is a sum over electrodes and over
    pairs of neighbours. So is the probability of the gaps. Places and depths are found in turn.

    size : half the number of rows of a picture. Electrodes that stay have no picture.
    """
    count, choices = at.size, 2 * reach + 1
    strength = np.zeros(count)
    seen = np.zeros((count, choices))
    both = np.zeros((count, 2 * choices - 1))
    _compare(strip, at, half, cosine, radius, inner, stays, reach, size, strength, seen, both)
    whole = 0.0
    for row in range(strip.shape[0]):
        for column in range(strip.shape[1]):
            whole += strip[row, column] * strip[row, column]
    # A first depth: that of the middle electrode where it is seen best.
    highest = np.zeros(count)
    drawn = 0
    for k in range(count):
        if strength[k] > 0.0:
            best = seen[k, 0]
            for choice in range(1, choices):
                best = max(best, seen[k, choice])
            # Sorted: electrodes are few, and a library's median takes seconds to compile.
            place = drawn
            while place > 0 and highest[place - 1] > best / strength[k]:
                highest[place] = highest[place - 1]
                place -= 1
            highest[place] = best / strength[k]
            drawn += 1
    depth = np.zeros(count)
    for k in range(count):
        depth[k] = max(0.5 * (highest[max(drawn - 1, 0) // 2] + highest[drawn // 2]), _NOTHING)
    samples = strip.shape[0] / (2 * size + 1)
    left = 0.5 * whole
    chosen = np.zeros(count, np.int64)
    for _ in range(_ITERATIONS):
        weight = 0.5 * _SAMPLES * samples / max(left, _LEAST_SHARE * whole, _NOTHING)
        _choose(at, gap_cosine, spacing, spacing_sd, shares, reach, weight, depth, strength, seen, both, chosen)
        # The depths of the tip and of the rings that explain most.
        tip_tip = tip_ring = ring_ring = tip_seen = ring_seen = 0.0
        for k in range(count):
            overlap = 0.0 if k == 0 else both[k, chosen[k] - chosen[k - 1] + 2 * reach]
            if k == 0:
                tip_tip, tip_seen = strength[0], seen[0, chosen[0]]
            else:
                ring_ring += strength[k] + (2.0 * overlap if k > 1 else 0.0)
                tip_ring += overlap if k == 1 else 0.0
                ring_seen += seen[k, chosen[k]]
        determinant = tip_tip * ring_ring - tip_ring * tip_ring
        if determinant > 1e-9 * tip_tip * ring_ring:
            tip = (tip_seen * ring_ring - ring_seen * tip_ring) / determinant
            ring = (ring_seen * tip_tip - tip_seen * tip_ring) / determinant
        else:
            tip, ring = tip_seen / max(tip_tip, 1e-9), ring_seen / max(ring_ring, 1e-9)
        tip, ring = max(tip, _NOTHING), max(ring, _NOTHING)
        for k in range(count):
            depth[k] = tip if k == 0 else ring
        left = whole - 2.0 * (tip * tip_seen + ring * ring_seen)
        left += tip * tip * tip_tip + 2.0 * tip * ring * tip_ring + ring * ring * ring_ring
    for k in range(count):
        moved[k] = (chosen[k] - reach) * STEP_PX
        if 0 < chosen[k] < choices - 1 and strength[k] > 0.0:
            near = np.zeros(3)
            for way in range(3):
                choice = chosen[k] + way - 1
                near[way] = seen[k, choice]
                if k > 0:
                    near[way] -= depth[k - 1] * both[k, choice - chosen[k - 1] + 2 * reach]
                if k < count - 1:
                    near[way] -= depth[k + 1] * both[k + 1, chosen[k + 1] - choice + 2 * reach]
            curvature = near[0] - 2.0 * near[1] + near[2]
            if curvature < 0.0:
                moved[k] += STEP_PX * min(max(0.5 * (near[0] - near[2]) / curvature, -0.5), 0.5)
    return left / max(whole, _NOTHING)
