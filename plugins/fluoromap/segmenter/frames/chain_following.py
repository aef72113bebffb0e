"""Chains that move on as before: fitted in the next image at their expected places, without a search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.catheters import Catheter
from fluoromap.contracts import Array, BoolArray, Chain
from fluoromap.segmenter.picture.field_mask import are_in
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.places import ellipse
from fluoromap.segmenter.places.refinement import refine

_CLEAR = 0.8
"""Clearness from which on the fit itself shows a catheter: the template explains about half of each profile."""
_ALONE_MM = 1.5
"""Distance from which on electrodes of two catheters are never one dark place."""
_LEAST_GAP = 0.35
"""Of the spacing at the isocentre. Nearer electrodes may be taken for each other."""


def follow_chains(
    x: Image,
    expected: Sequence[Chain],
    catheters: Sequence[Catheter],
    inside: BoolArray,
    px_per_mm: float,
    noise: float,
    reach_px: float,
) -> tuple[Chain, ...] | None:
    """Return the chains of the frame before at their places in this log image.

    They keep names, scores and tip. None where one of them needs a search: it is not clear here, its electrodes lie near each
    other, near those of another or outside the field, or one lies too far from its expected place.

    Parameters
    ----------
    x : (rows, columns) float32
        Log image.
    expected : sequence of Chain
        The chains where they would be if they moved on as before.
    catheters : sequence of Catheter
        The catheter of each chain.
    inside : (rows, columns) bool
        The field.
    px_per_mm : float
        At the isocentre.
    noise : float
        Standard deviation of a pixel, log units, see
        :attr:`~fluoromap.segmenter.electrodes.proposals.ImageEvidence.position_noise`.
    reach_px : float
        Largest distance of an electrode from its expected place.
    """
    if not _lie_alone([chain.pixels_uv for chain in expected], _ALONE_MM * px_per_mm):
        return None
    found: list[Chain | None] = [None] * len(expected)
    for catheter in dict.fromkeys(catheters):
        own = [index for index, other in enumerate(catheters) if other == catheter]
        places = np.stack([expected[index].pixels_uv for index in own])
        nothing = np.zeros(places.shape[:2], np.bool_)
        fit = refine(x, places, catheter, px_per_mm, noise, nothing, nothing)
        away = np.linalg.norm(fit.points_uv - places, axis=2)
        if (away > reach_px).any() or (fit.clearness < _CLEAR).any():
            return None
        gaps = np.linalg.norm(np.diff(fit.points_uv, axis=1), axis=2)
        if (gaps < _LEAST_GAP * px_per_mm * np.array(catheter.spacing_mm)).any():
            return None
        if not are_in(inside, fit.points_uv.reshape(-1, 2)).all():
            return None
        for row, index in enumerate(own):
            found[index] = replace(
                expected[index], pixels_uv=fit.points_uv[row], covariance_px2=fit.covariance_px2[row]
            )
    chains = [chain for chain in found if chain is not None]
    widened = []
    for chain in chains:
        others = [other for other in chains if other is not chain]
        widened.append(replace(chain, covariance_px2=ellipse.beside_other_electrodes(chain, others, px_per_mm)))
    return tuple(widened)


def _lie_alone(places: Sequence[Array], distance_px: float) -> bool:
    """Return whether no two chains (electrodes, 2) have electrodes within the distance."""
    for index, one in enumerate(places):
        for other in places[:index]:
            apart = one[:, None] - other
            if (apart * apart).sum(axis=2).min() < distance_px * distance_px:
                return False
    return True
