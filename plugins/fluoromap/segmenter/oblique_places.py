"""Final places of a picture's chains whose electrodes are seen obliquely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.acceptance import UNSEEN
from fluoromap.segmenter.chain_fitting import are_hidden
from fluoromap.segmenter.linking import shape_fit
from fluoromap.segmenter.log_image import Image
from fluoromap.segmenter.refinement import LEAST_GAP, ElectrodeFit, fit_obliquely

_MORE_LIKELY = 0.5
"""How much the log-likelihood of an electrode has to rise."""
_SD_OF_WAY = 0.5
"""Standard deviation that is added, as a share of the way that an electrode moves: the two fits differ by that way."""


def place_obliquely(x: Image, chains: Sequence[Chain], catalogue: Catalogue, px_per_mm: float) -> tuple[Chain, ...]:
    """Return a picture's chains, those whose electrodes are oblique cylinders with new places.

    A chain gets them where they are more likely, with the shape of its catheter. It remains as it is if it was set by hand or
    is not whole. Electrodes that are unseen or behind another chain keep their places.

    Parameters
    ----------
    x : (rows, columns) float32
        Log image.
    chains : sequence of Chain
    catalogue : Catalogue
    px_per_mm : float
        At the isocentre.
    """
    return tuple(
        _placed(x, chain, [other for other in chains if other is not chain], catalogue, px_per_mm) for chain in chains
    )


def _placed(x: Image, chain: Chain, others: Sequence[Chain], catalogue: Catalogue, px_per_mm: float) -> Chain:
    catheter = catalogue[max(chain.kinds, key=lambda kind: kind[1])[0]]
    if chain.manual or len(chain.electrodes) != catheter.electrodes:
        return chain
    places = chain.pixels_uv
    stays = (chain.scores <= UNSEEN) | are_hidden(places, others, px_per_mm)
    bands, cylinders = fit_obliquely(x, places, catheter, px_per_mm, stays)
    gained = _log_likelihood(cylinders, catheter, px_per_mm) - _log_likelihood(bands, catheter, px_per_mm)
    if gained <= _MORE_LIKELY * catheter.electrodes or _any_meet(cylinders, catheter, px_per_mm):
        return chain
    way = cylinders.points_uv[0] - places
    more: Array = _SD_OF_WAY**2 * way[:, :, None] * way[:, None, :]
    return replace(chain, pixels_uv=cylinders.points_uv[0], covariance_px2=chain.covariance_px2 + more)


def _log_likelihood(fit: ElectrodeFit, catheter: Catheter, px_per_mm: float) -> float:
    no_variance = np.zeros(fit.misfits.shape)
    return float((fit.log_likelihood + shape_fit(fit.points_uv, no_variance, catheter, px_per_mm))[0])


def _any_meet(fit: ElectrodeFit, catheter: Catheter, px_per_mm: float) -> bool:
    gaps = np.linalg.norm(np.diff(fit.points_uv[0], axis=0), axis=1)
    return bool((gaps < LEAST_GAP * px_per_mm * np.array(catheter.spacing_mm)).any())
