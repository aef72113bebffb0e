"""Sub-pixel positions of the electrodes: the middle of each band along and across."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, BoolArray, Chain
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.places import ellipse
from fluoromap.segmenter.shape.curve import predict_on_curve
from fluoromap.segmenter.shape.limits import LONG_TIP_MM, LONGEST, SHORTEST

_STEP_PX = 0.5
_REACH_PX = 3.5
_TIP_REACH_PX = 6.0
_LAST_REACH_PX = 2.0
LEAST_GAP = 0.15
"""Of the spacing at the isocentre. Nearer than that, two electrodes are fitted to one dark place."""
_SOFT_PX = 2.0
_TIP_REACH = 0.8
"""How far a long tip's middle is searched, over half its length: the first guess may lie near one of its ends."""
_NO_BAND_SD = 1e4
"""Standard deviation of a place for a pixel noise of 1, where a profile is not dark in its middle."""
_SPACING_SD = 0.10
_LONG_CATHETER = 6
_FEWEST_OF_PROFILE = 2
_WINDOW_MM = 2.0
_LEAST_MISFIT = 0.01
_CLEAR_PX, _LEAST_WINDOW_PX = 2.0, 2.0
_LEAST_HALF_PX = 0.75
_COVERED_PX = 30.0
_LOCAL, _LEAST_SHORTENING = 0.75, 0.15


@dataclass(frozen=True, eq=False)
class ElectrodeFit:
    """Positions of the electrodes of several chains.

    points_uv : (n, electrodes, 2) px.
    covariance_px2 : (n, electrodes, 2, 2).
    misfits : (n, electrodes), the share of each band's profile that its template does not explain.
    """

    points_uv: Array
    covariance_px2: Array
    misfits: Array

    @functools.cached_property
    def clearness(self) -> Array:
        """Mean of -ln(misfit) over the electrodes, (n,).

        It is 0 where no pixel looks like an electrode, and above 1 where the template explains most of each profile.
        """
        return _clearness(self.misfits)


def refine(
    image: Image,
    points_uv: Array,
    catheter: Catheter,
    px_per_mm: float,
    noise: float,
    hidden: BoolArray,
    without_blob: BoolArray,
) -> ElectrodeFit:
    """Move each electrode to where its band fits best.

    The band has the electrode's length and width. Along the axis the profile is compared with a box of the electrode's
    foreshortened length (the tip's far end is rounded), across the axis with the chord of a cylinder. The fit maximises
    the zero-mean correlation with a parabola through the best shift, in two rounds. Then points far off the catalogue's
    spacing are pulled towards it according to their uncertainty.

    Parameters
    ----------
    image : (rows, columns) float32
        Log image.
    points_uv : (n, electrodes, 2)
        First guess of each chain from the tip on, pixels.
    catheter : Catheter
    px_per_mm : float
        At the isocentre.
    noise : float
        Standard deviation of a pixel of the log image at half its size, log units, see
        :attr:`~fluoromap.segmenter.electrodes.proposals.ImageEvidence.position_noise`.
    hidden : (n, electrodes)
        Electrodes behind another catheter. They are put on the curve through the others and get the mean misfit of the
        others.
    without_blob : (n, electrodes)
        Electrodes without a blob of their own. They are searched only close by.
    """
    tip_reach = max(_TIP_REACH_PX, 0.5 * _TIP_REACH * catheter.tip_mm * px_per_mm)
    reach = np.full(points_uv.shape[:2], _REACH_PX)
    reach[:, 0] = tip_reach
    reach[hidden | without_blob] = _LAST_REACH_PX
    # A wrong first guess of a very long tip also gives a wrong length of its band.
    later = np.full(reach.shape, _LAST_REACH_PX)
    later[:, 0] = min(tip_reach, _TIP_REACH_PX)
    last = np.full(reach.shape, _LAST_REACH_PX)
    reaches = (reach, later, last) if tip_reach > _TIP_REACH_PX else (reach, last)
    return _fit(image, points_uv, catheter, px_per_mm, noise, hidden, reaches)


def _fit(
    image: Image,
    points_uv: Array,
    catheter: Catheter,
    px_per_mm: float,
    noise: float,
    hidden: BoolArray,
    reaches: Sequence[Array],
) -> ElectrodeFit:
    """Fit the bands of several chains in rounds.

    reaches : of each round, (n, electrodes) pixels.
    """
    points = np.array(points_uv, dtype=np.float64, order="C")
    arc_mm = catheter.arc_lengths_mm
    misfits, arc = np.zeros((2, *points.shape[:2]))
    axes, unit_sd, rests = np.empty((3, *points.shape))
    ends = np.empty(misfits.shape)
    sides = np.empty(misfits.shape, np.int64)
    radius = usual_radius_mm(catheter) * px_per_mm
    half = np.full(len(arc_mm), 0.5 * catheter.ring_mm * px_per_mm)
    half[0] = 0.5 * catheter.tip_mm * px_per_mm
    for reach in reaches:
        shifts = (reach / _STEP_PX).astype(np.int64)
        _measure_chains(points, arc_mm, px_per_mm, half, arc, axes, ends, sides)
        longest = max(int(sides.max()), int((radius + 4.0) / _STEP_PX))
        scratch = np.empty((3, 2 * longest + 2 * int(shifts.max()) + 1))
        _fit_bands(image, axes, ends, radius, shifts, sides, scratch, points, unit_sd, misfits, rests)
    _measure_chains(points, arc_mm, px_per_mm, half, arc, axes, ends, sides)
    sd = ellipse.noise_sd(unit_sd * noise, _clearness(misfits), catheter.tip_mm >= LONG_TIP_MM)
    if len(arc_mm) >= 3:
        _pull_to_spacing(points, sd, np.where(hidden, _COVERED_PX, sd[..., 0]), arc, axes, arc_mm, px_per_mm)
    # Not before: spacings of a bent catheter are no better than a disturbed fit.
    sd = ellipse.disturbed_sd(sd, rests, px_per_mm)
    fit = ElectrodeFit(points, ellipse.of_bands(points, sd, axes, arc_mm, px_per_mm), misfits)
    covariance = fit.covariance_px2
    for row in np.flatnonzero(hidden.any(axis=1)):
        is_hidden = hidden[row]
        if np.count_nonzero(~is_hidden) >= 2:
            points[row, is_hidden] = predict_on_curve(points[row], is_hidden, arc_mm)
            covariance[row, is_hidden] = ellipse.of_hidden(px_per_mm)
            misfits[row, is_hidden] = np.exp(np.log(np.maximum(misfits[row, ~is_hidden], _LEAST_MISFIT)).mean())
    return fit


def unexplained_sd(
    image: Image, chain_uv: Array, catheter: Catheter, electrodes: Sequence[int], px_per_mm: float
) -> tuple[Array, Array]:
    """Return how far unexplained rests would displace electrodes.

    What the template leaves of an electrode's profile counts as if it were noise.

    Parameters
    ----------
    image : (rows, columns) float32
        Log image.
    chain_uv : (n, 2)
        Places of two or more electrodes, pixels.
    catheter : Catheter
    electrodes : sequence of int
        Their numbers, from 1 at the tip on. The first has a tip's round end.
    px_per_mm : float
        At the isocentre.

    Returns
    -------
    axes : (n, 2, 2)
        Unit vectors along the catheter and across, of each electrode.
    sd : (n, 2)
        Standard deviation along and across, pixels. It is infinite where no band shows.
    """
    rows = np.array(electrodes) - 1
    arc_mm = catheter.arc_lengths_mm[rows]
    count = len(rows)
    points = np.array(chain_uv[None], dtype=np.float64, order="C")
    misfits, arc, ends = np.zeros((3, 1, count))
    axes, unit_sd, rests = np.empty((3, *points.shape))
    sides, still = np.empty((1, count), np.int64), np.zeros((1, count), np.int64)
    radius = usual_radius_mm(catheter) * px_per_mm
    half = np.where(rows == 0, 0.5 * catheter.tip_mm, 0.5 * catheter.ring_mm) * px_per_mm
    _measure_chains(points, arc_mm, px_per_mm, half, arc, axes, ends, sides)
    longest = max(int(sides.max()), int((radius + 4.0) / _STEP_PX))
    _fit_bands(image, axes, ends, radius, still, sides, np.empty((3, 2 * longest + 1)), points, unit_sd, misfits, rests)
    along = axes[0]
    sd = np.where(unit_sd[0] > _NO_BAND_SD, np.inf, rests[0])
    return np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1), sd


def with_unexplained_profile(
    x: Image, chains: Sequence[Chain], catalogue: Catalogue, px_per_mm: float, gain: float
) -> tuple[Chain, ...]:
    """Return a picture's chains with ellipses that cover the unexplained rests.

    Chains that were set by hand, or have one electrode, keep their covariance.

    Parameters
    ----------
    x : (rows, columns) float32
        Log image.
    chains : sequence of Chain
    catalogue : Catalogue
    px_per_mm : float
        At the isocentre.
    gain : float
        See :func:`~fluoromap.segmenter.places.ellipse.rest_gain`.
    """

    def covered(chain: Chain) -> Chain:
        if gain == 0.0 or chain.manual or len(chain.electrodes) < _FEWEST_OF_PROFILE:
            return chain
        catheter = catalogue[chain.likely_name]
        axes, rest_px = unexplained_sd(x, chain.pixels_uv, catheter, chain.electrodes, px_per_mm)
        return ellipse.with_rest_of_profile(chain, axes, rest_px, gain, px_per_mm)

    return tuple(covered(chain) for chain in chains)


def usual_radius_mm(catheter: Catheter) -> float:
    """Return the radius of a catheter, millimetres.

    It is that of 7F for the longer tips of ablation catheters, else that of 6F. Catalogues give none.
    """
    return 1.165 if catheter.tip_mm >= LONG_TIP_MM else 1.0


@kernel("f8[:,:,::1], f8[::1], f8, f8[::1], f8[:,::1], f8[:,:,::1], f8[:,::1], i8[:,::1]")
def _measure_chains(points, arc_mm, px_per_mm, half, arc, axes, ends, sides):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write arc lengths, axes, band lengths and profile lengths of all electrodes.

    arc : visible arc length up to each electrode, pixels.
    axes : unit vector along the catheter.
    ends : distance from a band's middle to its foreshortened ends. The foreshortening comes from the gaps beside it and from the
    whole catheter.
    sides : number of steps to each side over which the profile is compared. The profile ends before the next
    electrode's band, which would push the fit away.
    """
    last = arc_mm.size - 1
    for row in range(points.shape[0]):
        arc[row, 0] = 0.0
        for k in range(last):
            du, dv = points[row, k + 1, 0] - points[row, k, 0], points[row, k + 1, 1] - points[row, k, 1]
            arc[row, k + 1] = arc[row, k] + math.sqrt(du * du + dv * dv)
        whole = min(max(arc[row, last] / (arc_mm[last] * px_per_mm), SHORTEST), LONGEST)
        for k in range(last + 1):
            after, before = min(k + 1, last), max(k - 1, 0)
            ratio = (arc[row, after] - arc[row, before]) / (px_per_mm * (arc_mm[after] - arc_mm[before]))
            local = min(max(_LOCAL * ratio + (1.0 - _LOCAL) * whole, _LEAST_SHORTENING), LONGEST)
            ends[row, k] = max(half[k] * local, _LEAST_HALF_PX)
            du = points[row, after, 0] - points[row, before, 0]
            dv = points[row, after, 1] - points[row, before, 1]
            length = max(math.sqrt(du * du + dv * dv), 1e-9)
            axes[row, k, 0], axes[row, k, 1] = du / length, dv / length
        for k in range(last + 1):
            window = _WINDOW_MM * px_per_mm * whole + 2.0
            for beside in range(max(k - 1, 0), min(k + 2, last + 1)):
                if beside != k:
                    window = min(window, abs(arc[row, beside] - arc[row, k]) - ends[row, beside] - _CLEAR_PX)
            sides[row, k] = int(max(window, ends[row, k] + _LEAST_WINDOW_PX) / _STEP_PX)


@kernel(
    "f4[:,::1], f8[:,:,::1], f8[:,::1], f8, i8[:,::1], i8[:,::1], f8[:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8[:,:,::1]"
)
def _fit_bands(x, axes, ends, radius, shifts, sides, scratch, points, unit_sd, misfits, rests):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move the points to the best nearby positions of bands along these axes.

    Writes the standard deviations along and across for a pixel noise of 1, the share of the variance along the axis that
    stays unexplained, and what the unexplained rest of the profile would displace the band by if it were noise. A template moves
    over the profile, first along, then across the axis. A tip's far end is a dome of its radius.

    shifts, sides : largest shift and half length of the template, in steps.
    scratch : three lines of work space.
    """
    highest_u, highest_v = x.shape[1] - 1.001, x.shape[0] - 1.001
    template, profile, scores = scratch[0], scratch[1], scratch[2]
    for row in range(points.shape[0]):
        for k in range(points.shape[1]):
            du, dv, end = axes[row, k, 0], axes[row, k, 1], ends[row, k]
            side, shift, wide = sides[row, k], shifts[row, k], 1.5 * radius
            for way in range(2):
                m = 2 * side + 1
                mean = 0.0
                for i in range(m):
                    s = (i - side) * _STEP_PX
                    value = 1.0
                    rim = s / radius
                    if way == 0:
                        # The template rises from 0 to 1 and falls again; a tip's far end, at -end, is round.
                        inside = end - s if k == 0 else min(end - s, end + s)
                        value = min(max(0.5 + inside / _SOFT_PX, 0.0), 1.0)
                        rim = min(max(1.0 - rim - end / radius, 0.0), 1.0) if k == 0 else 0.0
                    value *= math.sqrt(max(1.0 - rim * rim, 0.0))
                    template[i] = value
                    mean += value
                mean /= m
                strength = edges = 0.0
                before = template[0] - mean
                for i in range(m):
                    value = template[i] - mean
                    template[i] = value
                    strength += value * value
                    edges += (value - before) * (value - before)
                    before = value
                lines = max(1, int(wide))
                for i in range(m + 2 * shift):
                    s = (i - side - shift) * _STEP_PX
                    total = 0.0
                    for line in range(lines):
                        w = wide * ((line + 0.5) / lines - 0.5)
                        u = min(max(points[row, k, 0] + s * du - w * dv, 0.0), highest_u)
                        v = min(max(points[row, k, 1] + s * dv + w * du, 0.0), highest_v)
                        left, top = int(u), int(v)
                        f, g = np.float32(u - left), np.float32(v - top)
                        # Unsigned: signed indices are checked for negative ones, six times a sample.
                        a, b = np.uintp(top), np.uintp(left)
                        c, d = np.uintp(top + 1), np.uintp(left + 1)
                        upper = x[a, b] + f * (x[a, d] - x[a, b])
                        lower = x[c, b] + f * (x[c, d] - x[c, b])
                        total += upper + g * (lower - upper)
                    profile[i] = total / lines
                chosen = 0
                for place in range(2 * shift + 1):
                    score = 0.0
                    for i in range(m):
                        score -= template[i] * profile[place + i]
                    scores[place] = score
                    if score > scores[chosen]:
                        chosen = place
                total = squares = 0.0
                for i in range(m):
                    value = profile[chosen + i]
                    total += value
                    squares += value * value
                best = scores[chosen]
                depth = max(best, 0.0) / max(strength, 1e-9)
                rest = max(squares - total * total / m - depth * best, 0.0)
                rests[row, k, way] = math.sqrt(rest * _STEP_PX / (m * max(edges, 1e-9))) / max(depth, 1e-6)
                if way == 0:
                    misfits[row, k] = max(1.0 - depth * best / max(squares - total * total / m, 1e-12), 0.0)
                # Cramer-Rao bound of a shift in white noise of 1 a pixel, averaged over the band's width.
                unit_sd[row, k, way] = math.sqrt(_STEP_PX / (wide * max(edges, 1e-9))) / max(depth, 1e-6)
                moved = float(chosen - shift)
                if 0 < chosen < 2 * shift:
                    curvature = scores[chosen - 1] - 2 * best + scores[chosen + 1]
                    if curvature < 0:
                        moved += 0.5 * (scores[chosen - 1] - scores[chosen + 1]) / curvature
                points[row, k, 0] += moved * _STEP_PX * du
                points[row, k, 1] += moved * _STEP_PX * dv
                du, dv = -dv, du
                side, shift, wide = int((radius + 4.0) / _STEP_PX), min(shift, 7), 2.0 * end


def _clearness(misfits: Array) -> Array:
    mean: Array = -np.log(np.maximum(misfits, _LEAST_MISFIT)).sum(axis=1) / misfits.shape[1]
    return mean


def _pull_to_spacing(
    points: Array, sd: Array, weighed_sd: Array, arc: Array, axes: Array, arc_mm: Array, px_per_mm: float
) -> None:
    """Combine measured arc lengths with the catalogue's spacing, in place.

    One foreshortening and one offset are free. A long catheter's foreshortening changes along it: a trend is free too.
    """
    variance = weighed_sd * weighed_sd
    model_sd = 0.5 * _SPACING_SD * px_per_mm * arc_mm[-1] / (len(arc_mm) - 1)
    weights = 1.0 / variance
    weights /= weights.sum(axis=1, keepdims=True)
    x = arc_mm - (weights @ arc_mm)[:, None]
    y = arc - (weights * arc).sum(axis=1, keepdims=True)
    weighed_x = weights * x
    slope = (weighed_x * y).sum(axis=1) / (weighed_x * x).sum(axis=1)
    rest = slope[:, None] * x - y
    if len(arc_mm) >= _LONG_CATHETER:
        bend = x * x
        bend -= (weights * bend).sum(axis=1, keepdims=True)
        bend -= ((weighed_x * bend).sum(axis=1) / (weighed_x * x).sum(axis=1))[:, None] * x
        trend = -(weights * bend * rest).sum(axis=1) / (weights * bend * bend).sum(axis=1)
        rest += trend[:, None] * bend
    share = variance / (variance + model_sd * model_sd)
    points += (share * rest)[..., None] * axes
    sd[..., 0] = weighed_sd * np.sqrt(1.0 - 0.5 * share)
