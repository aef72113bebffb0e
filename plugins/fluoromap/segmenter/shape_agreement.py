"""Ellipses of electrodes that lie off the smooth curve through the others of their chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.chain_axes import axes_of_chain
from fluoromap.segmenter.row_shape import shape_covariance_mm2

_FEWEST = 3
_PLACE_SD_MM = 0.05
"""How far an electrode's middle lies off its catheter's smooth curve."""
_AGREES, _LOOP_AGREES = 0.4, 1.0
"""The square of an electrode's distance from its prediction, over the square that is expected, up to which the chain agrees; the
ends of a loop are predicted less well."""
_ACROSS = 0.6
"""Standard deviation that is added across the catheter, as a share of the distance across. Along it the whole distance from the
prediction is added: openings of rings and neighbours displace electrodes along their catheter."""


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
    catheter = catalogue[max(chain.kinds, key=lambda kind: kind[1])[0]]
    rows = np.array(chain.electrodes) - 1
    off, relative = _off_the_curve(
        chain, shape_covariance_mm2(catheter.spacing_mm, catheter.curvature_per_mm)[np.ix_(rows, rows)] * px_per_mm**2,
        _PLACE_SD_MM * px_per_mm,
    )  # fmt: skip
    agrees = _LOOP_AGREES if catheter.is_circular else _AGREES
    weight = 1.0 - agrees / np.maximum(relative, agrees)
    axes = axes_of_chain(chain.pixels_uv)
    across = np.einsum("na,na->n", off, axes[:, 1])
    added_sd = np.stack([np.linalg.norm(off, axis=1), _ACROSS * across], axis=1)
    more = np.einsum("n,na,nai,naj->nij", weight, added_sd**2, axes, axes)
    return replace(chain, covariance_px2=chain.covariance_px2 + more)


def _off_the_curve(chain: Chain, shape_px2: Array, place_sd_px: float) -> tuple[Array, Array]:
    """Return how each electrode lies off the place that the others predict.

    The results are the way from there, (electrodes, 2) pixels, and the square of its length over what is expected of two
    coordinates, (electrodes,).

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
    places = chain.pixels_uv - chain.pixels_uv.mean(axis=0)
    pull = np.einsum("iajb,jb->ia", precision, places)
    off = np.linalg.solve(precision[each, :, each, :], pull[..., None])[..., 0]
    return off, np.einsum("ia,ia->i", off, pull)
