"""Rows of parts on a dark line, as the connector of an ECG cable: it is dark between its parts too, and often thick."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from fluoromap.contracts import Array
from fluoromap.segmenter.picture.shaft_image import ShaftImage
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES

_ON_MM, _BESIDE_MM, _AROUND_MM = (-0.3, 0.0, 0.3), (1.0, 1.25, 1.5), (2.75, 3.4, 4.0)
"""Distances from a chain's line: on it, beside the widest catheter of 8 French, and beside a cable."""
_FAN_RAD, _BEYOND_MM, _SAMPLES = np.deg2rad(np.linspace(-24.0, 24.0, 9)), (4.5, 8.0), 8
"""Directions of lines beyond a chain's ends, and where they are measured: past half of the longest tip."""
_GOES_ON, _LIGHT = 0.45, -0.25
"""Depth of a line beyond a chain, and of a gap that is clearly no part of it, as shares of the electrodes' depth."""
_LEAST_GAPS = 2
_SOLID, _JOINED = 1.3, 0.45
"""Depth of the gap within a doubted pair and of the gap beside it, as shares of the electrodes' depth."""
_DOUBTED, _LESS_PROBABLE = 1.3, 1.75
"""Most log-odds of both of a doubted pair, and how much less probable than the other pair it is on average."""


def depths_along(chain_uv: Array, shaft_image: ShaftImage) -> Array:
    """Return how dark a chain's line is at its electrodes and between them.

    Parameters
    ----------
    chain_uv : (electrodes, 2)
        Pixels.
    shaft_image : ShaftImage

    Returns
    -------
    (2 electrodes - 1, 2)
        At each electrode and in the middle of each gap, from the tip on: the depth of the line, and of what lies 1 to 1.5 mm
        beside it. Depths are those below the darker of both sides.
    """
    ways = np.diff(chain_uv, axis=0)
    places = np.empty((2 * len(chain_uv) - 1, 2))
    places[::2], places[1::2] = chain_uv, chain_uv[:-1] + 0.5 * ways
    along = np.empty_like(places)
    along[1::2] = ways
    along[::2] = np.concatenate([ways[:1], ways[1:] + ways[:-1], ways[-1:]])
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return _depths_at(places, along, shaft_image)


def depths_beyond(chain_uv: Array, shaft_image: ShaftImage) -> Array:
    """Return how dark lines are that go on beyond a chain's ends.

    Parameters
    ----------
    chain_uv : (electrodes, 2)
        Pixels.
    shaft_image : ShaftImage

    Returns
    -------
    (2,)
        Before the tip and behind the last electrode, of the darkest line there: the sum of both :func:`depths_along`, the median of
        places along the line.
    """
    ends, ways = chain_uv[[0, -1]], chain_uv[[0, -1]] - chain_uv[[1, -2]]
    angles = np.arctan2(ways[:, 1], ways[:, 0])[:, None] + _FAN_RAD
    along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)[:, :, None]
    steps = np.linspace(*_BEYOND_MM, _SAMPLES)[:, None] * shaft_image.px_per_mm
    places = ends[:, None, None] + along * steps
    depths = _depths_at(places.reshape(-1, 2), np.broadcast_to(along, places.shape).reshape(-1, 2), shaft_image)
    darkest: Array = np.median(depths.sum(axis=1).reshape(places.shape[:3]), axis=2).max(axis=1)
    return darkest


def _depths_at(places: Array, along: Array, shaft_image: ShaftImage) -> Array:
    """Return the depths of a line and of what lies beside it.

    It has these directions (n, 2) at the places (n, 2).
    """
    across_px = np.stack([-along[:, 1], along[:, 0]], axis=1) * shaft_image.px_per_mm
    left = [*_BESIDE_MM, *_AROUND_MM]
    offsets_mm = np.array([*_ON_MM, *left, *(-mm for mm in left)])
    at = places[:, None] + across_px[:, None] * offsets_mm[:, None]
    column, row = np.moveaxis((at + 0.5) / shaft_image.reduction - 0.5, -1, 0)
    levels = map_coordinates(shaft_image.smooth, [row, column], order=1, mode="nearest").astype(np.float64)
    on, left_beside, left_around, right_beside, right_around = (
        part.mean(axis=1) for part in np.split(levels, [3, 6, 9, 12], axis=1)
    )
    around = np.minimum(left_around, right_around)
    depths: Array = np.stack([around - on, around - 0.5 * (left_beside + right_beside)], axis=1)
    return depths


@dataclass(frozen=True, slots=True)
class DarkLineLimits:
    """From where on a chain lies on a dark line.

    thinnest : depth of the faintest gap as a share of the electrodes' depth. sure, sure_long : log-odds of the middle
    electrode that is believed on a dark line, and that of a row of six or more: lines have room for more parts.
    """

    thinnest: float
    sure: float
    sure_long: float


IN_FRAME = DarkLineLimits(thinnest=0.75, sure=1.0, sure_long=1.7)
"""For a single frame that nothing confirms. Shafts in the few labelled real frames are fainter."""


def gap_share(depths: Sequence[Array]) -> float:
    """Return how dark the gaps of a chain are.

    That is their median depth as a share of the electrodes' depth. It is about 0 for separate spots, 1 for parts of a
    line, and infinite where the electrodes are not dark. The depth of a gap is the sum of both :func:`depths_along`.

    Parameters
    ----------
    depths : sequence of (2 electrodes - 1, 2)
        Of the chain or of its sections, see :func:`depths_along`.
    """
    electrodes = _depth_of_electrodes(depths)
    gaps = np.concatenate(_depths_of_gaps(depths))
    return float(np.median(gaps)) / electrodes if electrodes > 0 else math.inf


def is_dark_line(depths: Sequence[Array], odds: Array, limits: DarkLineLimits) -> bool:
    """Return whether a chain lies on a line that is dark in each gap.

    A catheter's shaft is fainter than its electrodes, and ends 1.3 mm beside its middle. Some shafts are as dark, above all where
    the display evens out the picture; what clearly looks like electrodes is believed there. Electrodes near each other may hide the
    gap between them, but not the widest gap. The sum of both depths in each gap counts, as a share of the electrodes' depth. Of two
    electrodes it says nothing: the coil of a lead is as dark as its rings.

    Parameters
    ----------
    depths : sequence of (2 electrodes - 1, 2)
        Of the chain or of its sections, see :func:`depths_along`.
    odds : (electrodes,)
        Log-odds that they are electrodes.
    limits : DarkLineLimits
    """
    sure = limits.sure_long if len(odds) >= MANY_ELECTRODES else limits.sure
    gaps = _depths_of_gaps(depths)
    if sum(len(section) for section in gaps) < _LEAST_GAPS or np.median(odds) >= sure:
        return False
    electrodes = _depth_of_electrodes(depths)
    return electrodes > 0 and min(float(section.min()) for section in gaps) >= limits.thinnest * electrodes


def goes_on(depths: Sequence[Array], beyond: Array) -> bool:
    """Return whether a line goes on beyond both ends of a chain.

    The chain is a part of it then, as of a cable or a guide wire, if none of its gaps is clear. No shaft leaves a catheter's tip,
    and few lines cross there in the catheter's direction.

    Parameters
    ----------
    depths : sequence of (2 electrodes - 1, 2)
        Of the chain or of its sections, see :func:`depths_along`.
    beyond : (2,)
        See :func:`depths_beyond`.
    """
    electrodes = _depth_of_electrodes(depths)
    is_line = electrodes > 0 and min(float(section.min()) for section in _depths_of_gaps(depths)) >= _LIGHT * electrodes
    return is_line and float(beyond.min()) >= _GOES_ON * electrodes


def ends_on_coil(depths: Sequence[Array], odds: Array) -> bool:
    """Return whether a chain of four lies on a shock lead.

    It is the lead's ring and tip, and two places on its coil. The network is sure of two of them and doubts the others, which no
    gap parts. Rings whose images merge are parted from the other pair: there the gap is wider.

    Parameters
    ----------
    depths, odds : as for :func:`is_dark_line`
    """
    gaps = np.concatenate(_depths_of_gaps(depths))
    electrodes = _depth_of_electrodes(depths)
    if len(odds) != 4 or len(gaps) != 3 or electrodes <= 0:
        return False
    doubted, sure, gap = (
        (odds[:2], odds[2:], gaps[0]) if odds[:2].sum() < odds[2:].sum() else (odds[2:], odds[:2], gaps[2])
    )
    in_doubt = doubted.max() <= _DOUBTED and sure.mean() - doubted.mean() >= _LESS_PROBABLE
    return bool(in_doubt and gap >= _SOLID * electrodes and gaps[1] >= _JOINED * electrodes)


def _depth_of_electrodes(depths: Sequence[Array]) -> float:
    return float(np.median(np.concatenate([section[::2, 0] for section in depths])))


def _depths_of_gaps(depths: Sequence[Array]) -> list[Array]:
    return [section[1::2].sum(axis=1) for section in depths if len(section) > 1]
