"""Ellipses of electrodes in frames of which video coding has removed the fine noise.

The noise of such frames says little of how far their electrodes are displaced: what is left of it is smooth, and the coding changes
electrodes more than what lies between them. The unexplained rest of an electrode's profile shows that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import BoolArray, Chain, FrameSource
from fluoromap.segmenter.picture.grey_steps import usual_step
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.refinement import unexplained_sd

_OF_REST, _FOR_EACH_LEVEL = 1.7, 0.7
"""The least standard deviation over the unexplained rest where neighbouring pixels are alike, and how much less that is for each
grey level by which they usually differ. Fitted to simulated cines that were made without knowledge of this project."""
_MOST_MM = 0.2
"""Where the profile of an electrode hardly shows, its rest says nothing more."""
_FEWEST = 2


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


def widen_by_rest(
    x: Image, chains: Sequence[Chain], catalogue: Catalogue, px_per_mm: float, gain: float
) -> tuple[Chain, ...]:
    """Return a picture's chains with ellipses that cover the unexplained rests.

    Along the catheter and across none is smaller than a rest says. Chains that were set by hand, or have one electrode, keep their
    covariance.

    Parameters
    ----------
    x : (rows, columns) float32
        Log image.
    chains : sequence of Chain
    catalogue : Catalogue
    px_per_mm : float
        At the isocentre.
    gain : float
        See :func:`rest_gain`.
    """
    return tuple(
        chain
        if gain == 0.0 or chain.manual or len(chain.electrodes) < _FEWEST
        else _widened(x, chain, catalogue, px_per_mm, gain)
        for chain in chains
    )


def _widened(x: Image, chain: Chain, catalogue: Catalogue, px_per_mm: float, gain: float) -> Chain:
    catheter = catalogue[chain.likely_name]
    axes, rest = unexplained_sd(x, chain.pixels_uv, catheter, chain.electrodes, px_per_mm)
    least = np.minimum(gain * rest, _MOST_MM * px_per_mm) ** 2
    stated = np.einsum("nai,nij,naj->na", axes, chain.covariance_px2, axes)
    lacking = np.maximum(least - stated, 0.0)
    return replace(chain, covariance_px2=chain.covariance_px2 + np.einsum("na,nai,naj->nij", lacking, axes, axes))
