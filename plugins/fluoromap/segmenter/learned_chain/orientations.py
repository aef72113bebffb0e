"""The network asked about a picture in all its orientations: what it says of one and denies of another is luck."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fluoromap.segmenter.learned_chain.layers import HEADS
from fluoromap.segmenter.log_image import Image

_OFFSET_U, _OFFSET_V = HEADS.index("offset_u"), HEADS.index("offset_v")
_TRANSPOSED = [{_OFFSET_U: _OFFSET_V, _OFFSET_V: _OFFSET_U}.get(head, head) for head in range(len(HEADS))]


def mean_answer(network: Callable[[Image], Image], picture: Image) -> Image:
    """Return the mean of a network's answers to a picture in its eight orientations.

    Parameters
    ----------
    network : as :class:`~fluoromap.segmenter.learned_chain.forward.ElectrodeNetwork`
    picture : (rows, columns) float32

    Returns
    -------
    (rows / 2, columns / 2, heads) float32, in the orientation of the picture.
    """
    rows, columns = picture.shape
    total = np.zeros((rows // 2, columns // 2, len(HEADS)), np.float32)
    for mirrored_u in (False, True):
        for mirrored_v in (False, True):
            turned = _mirrored(picture, 0) if mirrored_v else picture
            turned = _mirrored(turned, 1) if mirrored_u else turned
            of_turned = network(np.ascontiguousarray(turned))
            of_turned = of_turned + network(np.ascontiguousarray(turned.T)).transpose(1, 0, 2)[..., _TRANSPOSED]
            if mirrored_u:
                of_turned = of_turned[:, ::-1]
                of_turned[..., _OFFSET_U] *= -1.0
            if mirrored_v:
                of_turned = of_turned[::-1]
                of_turned[..., _OFFSET_V] *= -1.0
            total += of_turned
    total /= 8.0
    return total


def _mirrored(picture: Image, axis: int) -> Image:
    """Return a picture mirrored so that cells of 2 x 2 px lie on cells.

    A cell answers for places around its first pixel, so the last row or column is repeated, not the first.
    """
    mirrored = np.flip(picture, axis)
    kept = np.take(mirrored, range(1, picture.shape[axis]), axis)
    return np.concatenate([kept, np.take(mirrored, [-1], axis)], axis)
