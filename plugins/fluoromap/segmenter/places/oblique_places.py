"""Final places of a picture's chains whose electrodes are seen obliquely."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Array, Chain
from fluoromap.segmenter.judge.acceptance import UNSEEN
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.places import ellipse
from fluoromap.segmenter.places.chain_fitting import are_hidden
from fluoromap.segmenter.places.cylinder_fit import fit_cylinders
from fluoromap.segmenter.places.refinement import usual_radius_mm
from fluoromap.segmenter.shape.spacings import shape_fit

_OBLIQUE, _LEAST_ELECTRODES = 0.9, 3
"""Visible over true length of a gap below which openings show, and how many electrodes have a line."""
_MORE_LIKELY, _MORE_LIKELY_SOLID = 0.75, 1.75
"""How much the log-likelihood of an electrode has to rise. Clearly solid rings have no openings that lead bands astray."""


def place_obliquely(x: Image, chains: Sequence[Chain], catalogue: Catalogue, px_per_mm: float) -> tuple[Chain, ...]:
    """Return a picture's chains, those whose electrodes are oblique cylinders with new places.

    A chain gets them where they are more likely, with the shape of its catheter. It remains as it is if it was set by hand, is
    not whole, or shows nearly the whole length of each gap. Electrodes that are unseen or behind another chain keep their places.

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
    catheter = catalogue[chain.likely_name]
    places = chain.pixels_uv
    is_whole = len(places) == catheter.electrodes and len(places) >= _LEAST_ELECTRODES
    if chain.manual or not is_whole or not _is_oblique(places, catheter, px_per_mm):
        return chain
    stays = (chain.scores <= UNSEEN) | are_hidden(places, others, px_per_mm)
    fit = fit_cylinders(x, places, catheter, px_per_mm, usual_radius_mm(catheter), stays)
    both = np.stack([places, fit.points_uv])
    shape = shape_fit(both, np.zeros(both.shape[:2]), catheter, px_per_mm)
    least = _MORE_LIKELY_SOLID if fit.is_solid else _MORE_LIKELY
    if fit.log_likelihood + float(shape[1] - shape[0]) <= least * len(places):
        return chain
    return ellipse.moved_obliquely(chain, fit.points_uv)


def _is_oblique(chain_uv: Array, catheter: Catheter, px_per_mm: float) -> bool:
    seen_px = np.sqrt((np.diff(chain_uv, axis=0) ** 2).sum(axis=1))
    return catheter.is_circular or bool((seen_px < _OBLIQUE * px_per_mm * np.array(catheter.spacing_mm)).any())
