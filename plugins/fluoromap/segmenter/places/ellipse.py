"""The ellipse of an electrode: the sources of the error of its place, and how each of them makes the covariance.

This is the only module that makes or widens a covariance of an electrode of a chain. The others say what they have measured. Each
source has one function:

======================================  ==============================================================================
source                                  where its size comes from
======================================  ==============================================================================
noise of the frame                      Cramer-Rao bound of a shift in white noise, times fitted gains
simplified templates                    floors that remain without noise
a profile that the template misses      power of its rest over that of the chain's middle electrode
a steep tip                             square of what the visible first gap lacks
another electrode beside                factor where it is near, standard deviation where both may be one dark place
hidden, and put on a curve              one standard deviation
returned to its candidate               the way between both places
found again in another frame            weighing against the other frame's shape, by how far catheters bend in the time
found in a mean that holds the frame    one standard deviation
an oblique electrode that was moved     share of the way, by which the two fits differ
scale of the picture                    fitted power of the scale
coded video                             least ratio to the unexplained profile, fitted to simulated cines
jitter of the shape                     measured over its expectation, by the median of a chi-square variable
lag                                     share of the shift by which the shadow of the frame before draws the place back
shape of the row                        distance from where the other electrodes predict it, over its expectation
======================================  ==============================================================================

The order in which a run uses them is in :mod:`~fluoromap.segmenter.runs.final_ellipses`.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, BoolArray, Chain, FrameChains, FrameSource
from fluoromap.segmenter.picture.grey_steps import usual_step
from fluoromap.segmenter.shape.chain_axes import axes_of_chain
from fluoromap.segmenter.shape.chain_comparison import mean_shift
from fluoromap.segmenter.shape.limits import TURNING_ELECTRODES
from fluoromap.segmenter.shape.row_shape import shape_covariance_mm2

_FITTED_PX_PER_MM = 5.75
"""The scale at which the gains were fitted, pixels per mm at the isocentre."""
_GAIN, _TIP_GAIN = (4.6, 4.8), (6.15, 5.7)
"""Standard deviation along the catheter and across it, over the bound that white noise sets: of a ring, of a tip."""
_FLOOR_PX, _TIP_FLOOR_PX, _LONG_TIP_FLOOR_PX = (0.027, 0.034), (0.072, 0.04), (0.124, 0.04)
"""Standard deviation along and across that remains without noise, pixels."""
_BLUR_GAIN, _USUAL_CLEARNESS = 0.7, 1.8
"""How much the detector's blur adds to the gain for each unit of clearness that a chain has less than usual."""
_MOST_PX = 6.0
"""Largest standard deviation of an electrode that a band shows: farther away another electrode would have been fitted."""
_USUAL_REST, _REST_POWER, _TINY_REST = np.array([1.0, 0.9]), np.array([0.8, 1.33]), 1e-12
"""The unexplained rest of a profile, along and across, as a multiple of that of the chain's middle electrode: from here on it
widens the standard deviation, in this power."""
_SEARCH_POWER, _FINAL_POWER = 0.25, 0.15
"""Powers of the scale with which the standard deviation grows: noise that goes together in neighbouring pixels averages out less,
the more pixels an electrode has. By the second one the final ellipses grow more than those of the search do."""
_STEEP, _STEEP_MM, _STEEP_SECOND = 0.80, 1.0, 0.7
"""Visible over true length of the first gap below which a tip is steep, the standard deviation for the square of what is lacking,
mm, and the share of it for the ring."""
_NEAR_MM, _NEAR_FACTOR = 3.0, 2.5
"""How near an electrode of another chain disturbs, and the factor of the covariance then."""
_MERGED_MM, _MERGED_SD_MM = 1.5, 0.8
"""How near electrodes of one long chain may be fitted to one dark place, and the standard deviation where they are."""
_HIDDEN_MM = 0.25
"""Standard deviation of a place on the curve through the other electrodes."""
_STRAY_PX = 5.0
"""Farther than this from where the other frame's shape lies, a band is something else."""
_LESS_SURE = 2.2
"""Factor of the covariance of a chain that was found again: frames that show it less well are searched this way. It is no
doubt about the catheter's shape."""
_BENDING, _LEAST_REACH_PX, _SMOOTH_PX = 0.12, 6.5, 35.0
"""How far a catheter bends, as a share of how far it may move, of which short reaches count by their square over the last."""
_IN_MEAN_PX = 3.0
"""Standard deviation of a place in a mean, for a frame that is part of the mean."""
_SD_OF_WAY, _SD_BESIDE = 0.4, 0.15
"""Standard deviation that is added, as a share of the way that an oblique electrode moves: along the way, by which the two fits
differ, and in all directions, because the line that it moves along bends."""
_OF_REST, _FOR_EACH_LEVEL = 1.7, 0.7
"""Least ratio of the standard deviation to the unexplained rest. The first number holds where neighbouring pixels are alike. The
second is subtracted for each grey level by which they differ. Fitted to simulated cines that were made without knowledge of
this project."""
_MOST_REST_MM = 0.2
"""Where the profile of an electrode hardly shows, its rest says nothing more."""
_FEWEST_OF_JITTER, _LEAST_TRIPLES = 3, 3
_MEDIAN_CHI2 = 0.4549
"""Median of the square of a standard normal variable."""
_MOST_UNSTEADY_MM = 2.0
"""How far a chain may be from the middle between the frames before and after. What moves more unsteadily may change its shape."""
_LEAST_LEFT = 0.1
"""Share of an electrode's variance that a linear function leaves, from which on the electrode says something."""
_TINY = 1e-9
_OF_SHIFT, _MOST_LAG_MM = 2.0, 0.2
"""Standard deviation that lag adds, over lag times the shift since the frame before, and at most: a shadow that has come
apart from its electrode displaces it no more."""
_FEWEST_OF_SHAPE = 3
_PLACE_SD_MM = 0.05
"""How far an electrode's middle lies off its catheter's smooth curve."""
_AGREES, _LOOP_AGREES = np.array([0.4, 0.1]), 1.0
"""Largest square of an electrode's distance from its prediction that is no reason to widen its ellipse, over the square that is
expected: along the catheter and across it, and on a loop. It is below 1, because catheters mostly bend less than they can. On a
loop it is 1, because the others predict its ends less well."""
_NOISE_AGREES = 2.0
"""The same where the ellipses alone make up the expected distance: what they say already does not widen them."""


def noise_sd(bound: Array, clearness: Array, long_tip: bool) -> Array:
    """Return the standard deviations along and across, (n, electrodes, 2) pixels.

    The detector's blur increases the contribution of noise. Badly fitting bands have long-tailed errors. Without noise the
    simplifications of the templates remain, most of all at a tip's rounded end.

    Parameters
    ----------
    bound : (n, electrodes, 2)
        What white noise contributes at least, pixels.
    clearness : (n,)
        See :attr:`~fluoromap.segmenter.places.refinement.ElectrodeFit.clearness`.
    long_tip : bool
        Whether the catheter's tip is longer than its rings for certain.
    """
    gain, floor = _gains_and_floors(bound.shape[1], long_tip)
    blur_gain = 1.0 + _BLUR_GAIN * np.maximum(_USUAL_CLEARNESS - clearness, 0.0)
    sd = bound * gain * blur_gain[:, None, None]
    stated: Array = np.minimum(np.sqrt(sd * sd + floor * floor), _MOST_PX)
    return stated


def disturbed_sd(sd: Array, rests: Array, px_per_mm: float) -> Array:
    """Return standard deviations that cover what disturbs a band, (n, electrodes, 2) pixels.

    Where the template leaves more unexplained than at the chain's middle electrode, something else lies there, as a cable, and
    displaces the electrode.

    Parameters
    ----------
    sd : (n, electrodes, 2)
        Along and across, pixels.
    rests : (n, electrodes, 2)
        What is unexplained.
    px_per_mm : float
        At the isocentre.
    """
    usual = _USUAL_REST * np.maximum(np.median(rests, axis=1, keepdims=True), _TINY_REST)
    factors: Array = np.maximum(rests / usual, 1.0) ** _REST_POWER
    disturbed: Array = np.minimum(sd * factors * (px_per_mm / _FITTED_PX_PER_MM) ** _SEARCH_POWER, _MOST_PX)
    return disturbed


@functools.lru_cache(maxsize=64)
def _gains_and_floors(electrodes: int, long_tip: bool) -> tuple[Array, Array]:
    """Return gain and floor of each electrode along and across, (electrodes, 2)."""
    gain, floor = np.full((electrodes, 2), _GAIN), np.full((electrodes, 2), _FLOOR_PX)
    gain[0] = _TIP_GAIN
    floor[0] = _LONG_TIP_FLOOR_PX if long_tip else _TIP_FLOOR_PX
    return gain, floor


def of_bands(points: Array, sd: Array, axes: Array, arc_mm: Array, px_per_mm: float) -> Array:
    """Return the covariances (n, electrodes, 2, 2), square pixels.

    A steeply foreshortened tip covers the ring behind it, and its axis is uncertain.

    Parameters
    ----------
    points, sd, axes : (n, electrodes, 2)
        Places, standard deviations along and across, pixels, and unit vectors along the catheter.
    arc_mm : (electrodes,)
        Lengths along the catheter from the tip on.
    px_per_mm : float
        At the isocentre.
    """
    variance = sd * sd
    first = points[:, 1] - points[:, 0]
    lacking = np.maximum(_STEEP - np.sqrt((first * first).sum(axis=1)) / (px_per_mm * (arc_mm[1] - arc_mm[0])), 0.0)
    steep = (_STEEP_MM * px_per_mm * lacking * lacking) ** 2
    variance[:, 0] += steep[:, None]
    variance[:, 1] += _STEEP_SECOND**2 * steep[:, None]
    along, across = variance[..., 0], variance[..., 1]
    u, v = axes[..., 0], axes[..., 1]
    covariance = np.empty((*along.shape, 2, 2))
    covariance[..., 0, 0] = along * u * u + across * v * v
    covariance[..., 1, 1] = along * v * v + across * u * u
    covariance[..., 0, 1] = covariance[..., 1, 0] = (along - across) * u * v
    return covariance


def beside_other_electrodes(chain: Chain, others: Sequence[Chain], px_per_mm: float) -> Array:
    """Return the chain's covariances, widened near other electrodes.

    Bands that lie close together disturb each other's fit: those of other chains, and those of a long catheter that turns through
    the viewing direction, where several of its electrodes may be fitted to one dark place.
    """
    covariance = chain.covariance_px2
    if len(chain.electrodes) >= TURNING_ELECTRODES:
        apart = np.linalg.norm(chain.pixels_uv[:, None] - chain.pixels_uv, axis=2)
        np.fill_diagonal(apart, np.inf)
        merged = np.maximum(1.0 - apart.min(axis=1) / (_MERGED_MM * px_per_mm), 0.0)
        covariance = covariance + ((_MERGED_SD_MM * px_per_mm * merged) ** 2)[:, None, None] * np.eye(2)
    if not others:
        return covariance
    beside = np.concatenate([other.pixels_uv for other in others])
    difference = chain.pixels_uv[:, None] - beside
    near = np.sqrt((difference * difference).sum(axis=2).min(axis=1)) < _NEAR_MM * px_per_mm
    return np.where(near[:, None, None], _NEAR_FACTOR, 1.0) * covariance


def of_hidden(px_per_mm: float) -> Array:
    """Return the covariance of a place on the others' curve, (2, 2) pixels²."""
    return (_HIDDEN_MM * px_per_mm) ** 2 * np.eye(2)


def returned(covariance_px2: Array, moved_px: Array, back: BoolArray) -> Array:
    """Return the covariances (n, electrodes, 2, 2) after some electrodes returned to their candidates.

    The way between both places (n, electrodes) adds to those that are ``back`` (n, electrodes).
    """
    covariance: Array = covariance_px2 + np.where(back, moved_px**2, 0.0)[..., None, None] * np.eye(2)
    return covariance


def weighed_with_shape(
    expected_uv: Array, found_uv: Array, found_px2: Array, shape_px2: Array, reach_px: float
) -> tuple[Array, Array]:
    """Return places and covariances of a chain found in another frame.

    Each place is weighed against that of the other frame's shape. A band that is far from there is something else, and
    hardly counts.

    Parameters
    ----------
    expected_uv : (electrodes, 2)
        Where the shape of the other frame lies in this one, pixels.
    found_uv : (electrodes, 2)
        Where the bands fit.
    found_px2, shape_px2 : (electrodes, 2, 2)
        Covariances of the bands, and of the places in the other frame.
    reach_px : float
        How far the catheter may be from where it was expected.
    """
    is_stray = np.linalg.norm(found_uv - expected_uv, axis=1) > _STRAY_PX
    covariance = np.where(is_stray[:, None, None], (4 * _STRAY_PX) ** 2 * np.eye(2), found_px2)
    expected = shape_px2 / _LESS_SURE + _bending_px(reach_px) ** 2 * np.eye(2)
    gain = expected @ np.linalg.inv(expected + covariance)
    points = expected_uv + np.einsum("nij,nj->ni", gain, found_uv - expected_uv)
    covariance = gain @ covariance
    return points, 0.5 * _LESS_SURE * (covariance + covariance.transpose(0, 2, 1))


def _bending_px(reach_px: float) -> float:
    """Return the standard deviation of a place from the shape of an earlier frame, pixels.

    Catheters bend smoothly: from one frame of a fast run to the next the shape hardly changes.
    """
    return _BENDING * min(reach_px, max(_LEAST_REACH_PX, reach_px * reach_px / _SMOOTH_PX))


def of_mean(chain: Chain) -> Chain:
    """Return a mean's chain for the search in one of its frames.

    Its place in the mean is no independent measurement.
    """
    return replace(chain, covariance_px2=chain.covariance_px2 + _IN_MEAN_PX**2 * np.eye(2))


def moved_obliquely(chain: Chain, points_uv: Array) -> Chain:
    """Return a chain at the places of its electrodes as oblique cylinders.

    The way to the places (n, 2) adds to its covariances.
    """
    way = points_uv - chain.pixels_uv
    beside = _SD_BESIDE**2 * (way * way).sum(axis=1)
    more: Array = _SD_OF_WAY**2 * way[:, :, None] * way[:, None, :] + beside[:, None, None] * np.eye(2)
    return replace(chain, pixels_uv=points_uv, covariance_px2=chain.covariance_px2 + more)


def at_scale(chains: Sequence[Chain], px_per_mm: float) -> tuple[Chain, ...]:
    """Return a picture's chains with the ellipses that their errors have at this scale.

    The search counts electrodes of few pixels as less sure than they are: it weighs their places against the shape of their chain,
    and loses less where it trusts the shape. Chains that were set by hand keep their ellipses.

    Parameters
    ----------
    chains : sequence of Chain
    px_per_mm : float
        At the isocentre.
    """
    factor = (px_per_mm / _FITTED_PX_PER_MM) ** (2.0 * _FINAL_POWER)
    return tuple(
        chain if chain.manual else replace(chain, covariance_px2=factor * chain.covariance_px2) for chain in chains
    )


def rest_gain(frames: FrameSource, inside: BoolArray, bits_stored: int) -> float:
    """Return how large a standard deviation is over the unexplained rest.

    That of an electrode's place is no smaller than this times the rest of its profile.

    Parameters
    ----------
    frames : FrameSource
    inside : (rows, columns) bool
        The exposed field.
    bits_stored : int
        Significant bits of a pixel. Video has eight.

    Returns
    -------
    float
        0 where neighbouring pixels differ by two and a half grey levels and more: then noise says how sure the places are.
    """
    return max(_OF_REST - _FOR_EACH_LEVEL * usual_step(frames, inside, bits_stored), 0.0)


def with_rest_of_profile(chain: Chain, axes: Array, rest_px: Array, gain: float, px_per_mm: float) -> Chain:
    """Return a chain with ellipses that cover the unexplained rests of its profiles.

    The noise of frames that video coding has smoothed says little of how far electrodes are displaced: the coding changes
    electrodes more than what lies between them. Along the catheter and across no ellipse is smaller than a rest says.

    Parameters
    ----------
    chain : Chain
    axes : (n, 2, 2)
        Unit vectors along the catheter and across, of each electrode.
    rest_px : (n, 2)
        How far the rests would displace the electrodes along and across, pixels.
    gain : float
        See :func:`rest_gain`.
    px_per_mm : float
        At the isocentre.
    """
    least = np.minimum(gain * rest_px, _MOST_REST_MM * px_per_mm) ** 2
    stated = np.einsum("nai,nij,naj->na", axes, chain.covariance_px2, axes)
    lacking = np.maximum(least - stated, 0.0)
    return replace(chain, covariance_px2=chain.covariance_px2 + np.einsum("na,nai,naj->nij", lacking, axes, axes))


def with_jitter(
    entries: Sequence[FrameChains], diastole: Sequence[Chain], px_per_mm: float
) -> tuple[tuple[FrameChains, ...], tuple[Chain, ...]]:
    """Return a run's chains, with wider ellipses where the shape of a track jitters.

    A catheter bends smoothly in time: its shape in one frame is nearly the mean of those before and after. What remains is error
    of the places, and the ellipses foretell its size. Where it is larger, all ellipses of the track grow by that ratio, along
    the catheter and across it. They never shrink: errors that are the same in successive frames do not show. Chains that were
    set by hand keep their ellipses.

    Parameters
    ----------
    entries : sequence of FrameChains
        One for each frame.
    diastole : sequence of Chain
        The chains at diastole, with the numbers of their tracks.
    px_per_mm : float
        At the isocentre.

    Returns
    -------
    entries, diastole : tuple of FrameChains, tuple of Chain
    """
    tracks: dict[int, dict[int, Chain]] = {}
    for entry in entries:
        for chain in entry.chains:
            if not chain.manual:
                tracks.setdefault(chain.track, {})[entry.frame] = chain
    factors = {track: _jitter_factors(chains, px_per_mm) for track, chains in tracks.items()}

    def widen(chains: Sequence[Chain]) -> tuple[Chain, ...]:
        return tuple(
            chain if chain.manual or chain.track not in factors else _with_factors(chain, factors[chain.track])
            for chain in chains
        )

    return tuple(replace(entry, chains=widen(entry.chains)) for entry in entries), widen(diastole)


def _jitter_factors(track: dict[int, Chain], px_per_mm: float) -> Array:
    """Return the factors of a track's standard deviations, (2,).

    Along the catheter and across it, at least 1.
    """
    triples = []
    for frame, chain in track.items():
        before, after = track.get(frame - 1), track.get(frame + 1)
        if before is None or after is None or len(chain.electrodes) < _FEWEST_OF_JITTER:
            continue
        if before.electrodes == chain.electrodes == after.electrodes:
            jitter = chain.pixels_uv - 0.5 * (before.pixels_uv + after.pixels_uv)
            if np.linalg.norm(jitter.mean(axis=0)) <= _MOST_UNSTEADY_MM * px_per_mm:
                covariance = chain.covariance_px2 + 0.25 * (before.covariance_px2 + after.covariance_px2)
                triples.append(_jitter_over_expected(chain.pixels_uv, jitter, covariance))
    if len(triples) < _LEAST_TRIPLES:
        return np.ones(2)
    of_all: Array = np.median(np.concatenate(triples), axis=0)
    factors: Array = np.sqrt(np.maximum(of_all / _MEDIAN_CHI2, 1.0))
    return factors


def _jitter_over_expected(places_uv: Array, jitter: Array, covariance: Array) -> Array:
    """Return the squares of a shape's jitter over their expectation, (electrodes, 2).

    Along the catheter, and across it. Displacement, turning and a change of foreshortening are no jitter: they are linear in
    the arc.
    """
    axes = axes_of_chain(places_uv)
    expected = np.einsum("nai,nij,naj->na", axes, covariance, axes)
    weight = 1.0 / np.sqrt(expected.sum(axis=1))
    steps = np.linalg.norm(np.diff(places_uv, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    linear, _ = np.linalg.qr(weight[:, None] * np.column_stack([np.ones_like(arc), arc / max(arc[-1], _TINY)]))
    weighted = weight[:, None] * jitter
    left = (weighted - linear @ (linear.T @ weighted)) / weight[:, None]
    share_left = 1.0 - (linear * linear).sum(axis=1)
    decides = share_left > _LEAST_LEFT
    squares: Array = np.einsum("nai,ni->na", axes, left)[decides] ** 2 / (expected * share_left[:, None])[decides]
    return squares


def _with_factors(chain: Chain, factors: Array) -> Chain:
    if len(chain.electrodes) < 2 or not (factors > 1.0).any():
        return chain
    axes = axes_of_chain(chain.pixels_uv)
    scale = np.einsum("nai,a,naj->nij", axes, factors, axes)
    covariance = scale @ chain.covariance_px2 @ scale
    return replace(chain, covariance_px2=0.5 * (covariance + covariance.transpose(0, 2, 1)))


def with_lag(entries: Sequence[FrameChains], lag: float, px_per_mm: float) -> tuple[FrameChains, ...]:
    """Return the chains of all frames, wider along their motion.

    A shadow of the frame before draws the place of a moving electrode towards where it was. Chains that were set by hand keep their
    covariance.

    Parameters
    ----------
    entries : sequence of FrameChains
        Tracked chains of successive frames.
    lag : float
        See :func:`measure_lag`.
    px_per_mm : float
    """
    if lag == 0.0:
        return tuple(entries)
    tracks = [{chain.track: chain for chain in entry.chains} for entry in entries]
    widened = []
    for index, entry in enumerate(entries):
        nearest = [tracks[beside] for beside in (index - 1, index + 1) if 0 <= beside < len(entries)]
        chains = tuple(_with_shadow(chain, nearest, lag, _MOST_LAG_MM * px_per_mm) for chain in entry.chains)
        widened.append(replace(entry, chains=chains))
    return tuple(widened)


def _with_shadow(chain: Chain, nearest: Sequence[Mapping[int, Chain]], lag: float, most_px: float) -> Chain:
    beside = next((chains[chain.track] for chains in nearest if chain.track in chains), None)
    if beside is None or chain.manual:
        return chain
    shift = mean_shift(beside, chain)
    length = float(np.linalg.norm(shift))
    if length == 0.0:
        return chain
    along = min(_OF_SHIFT * lag * length, most_px) / length * shift
    return replace(chain, covariance_px2=chain.covariance_px2 + np.outer(along, along))


def with_shape(chains: Sequence[Chain], catalogue: Catalogue, px_per_mm: float) -> tuple[Chain, ...]:
    """Return a picture's chains, with wider ellipses where their shape is unlikely.

    The fit of a single band cannot know that a cable, another electrode or an opening of its ring has displaced it. The other
    electrodes of the chain predict its place. Chains that were set by hand, or have fewer than three electrodes, keep their
    covariance.

    Parameters
    ----------
    chains : sequence of Chain
    catalogue : Catalogue
    px_per_mm : float
        At the isocentre.
    """
    return tuple(
        chain
        if chain.manual or len(chain.electrodes) < _FEWEST_OF_SHAPE
        else _off_its_shape(chain, catalogue, px_per_mm)
        for chain in chains
    )


def _off_its_shape(chain: Chain, catalogue: Catalogue, px_per_mm: float) -> Chain:
    catheter = catalogue[chain.likely_name]
    rows = np.array(chain.electrodes) - 1
    axes = axes_of_chain(chain.pixels_uv)
    off, expected, noise = _off_the_curve(
        chain,
        shape_covariance_mm2(catheter.spacing_mm, catheter.curvature_per_mm)[np.ix_(rows, rows)] * px_per_mm**2,
        _PLACE_SD_MM * px_per_mm,
        axes,
    )
    of_shape = _LOOP_AGREES if catheter.is_circular else _AGREES
    agrees = of_shape + noise / expected * (_NOISE_AGREES - of_shape)
    added = off**2 * (1.0 - agrees / np.maximum(off**2 / expected, agrees))
    # What displaces an electrode across its catheter may displace it along as well.
    added[:, 0] += added[:, 1]
    return replace(chain, covariance_px2=chain.covariance_px2 + np.einsum("na,nai,naj->nij", added, axes, axes))


def _off_the_curve(chain: Chain, shape_px2: Array, place_sd_px: float, axes: Array) -> tuple[Array, Array, Array]:
    """Return how each electrode lies off the place that the others predict.

    The results, along the catheter and across, (electrodes, 2) each, are the distance from there, pixels, the expected square of
    this distance, and the part of the expected square that is due to the ellipses.

    The inverse of the covariance of all coordinates has, in its blocks, the precision of each place given the others.
    """
    count = len(shape_px2)
    # With this variance the whole chain may lie anywhere.
    of_one = shape_px2 + place_sd_px**2 * np.eye(count) + 1e6
    whole = np.zeros((count, 2, count, 2))
    whole[:, 0, :, 0] = whole[:, 1, :, 1] = of_one
    each = np.arange(count)
    whole[each, :, each, :] += chain.covariance_px2
    precision = np.linalg.inv(whole.reshape(2 * count, 2 * count)).reshape(count, 2, count, 2)
    given_others = np.linalg.inv(precision[each, :, each, :])
    # The distances are this linear function of the places.
    distance = np.einsum("nai,nij,njmk->namk", axes, given_others, precision)
    off = np.einsum("namk,mk->na", distance, chain.pixels_uv - chain.pixels_uv.mean(axis=0))
    expected = np.einsum("nai,nij,naj->na", axes, given_others, axes)
    noise = np.einsum("nami,mij,namj->na", distance, chain.covariance_px2, distance)
    return off, expected, noise
