"""Ellipses of electrodes that lie off the smooth curve through the others of their chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.shape.chain_axes import axes_of_chain
from fluoromap.segmenter.shape.row_shape import shape_covariance_mm2

_FEWEST = 3
_PLACE_SD_MM = 0.05
"""How far an electrode's middle lies off its catheter's smooth curve."""
_AGREES, _LOOP_AGREES = np.array([0.4, 0.1]), 1.0
"""The square of an electrode's distance from its prediction, along the catheter and across, over its expectation, up to which the
chain agrees where the places themselves are sure. Catheters mostly bend less than they can, and where they lie across the rays they
are as long as they can be. The ends of a loop are predicted less well."""
_NOISE_AGREES = 2.0
"""The same where the expected distance is all due to the ellipses: what they say already is no reason to widen them."""


def widen_by_shape(chains: Sequence[Chain], catalogue: Catalogue, px_per_mm: float) -> tuple[Chain, ...]:
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
        chain if chain.manual or len(chain.electrodes) < _FEWEST else _widened(chain, catalogue, px_per_mm)
        for chain in chains
    )


def _widened(chain: Chain, catalogue: Catalogue, px_per_mm: float) -> Chain:
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
