"""The network asked about a picture in several orientations: what it says of one and denies of another is luck."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fluoromap.segmenter.electrodes.network.layers import HEADS
from fluoromap.segmenter.picture.log_image import Image

ALL_ORIENTATIONS = 8

_OFFSET_U, _OFFSET_V = HEADS.index("offset_u"), HEADS.index("offset_v")
_TRANSPOSED = [{_OFFSET_U: _OFFSET_V, _OFFSET_V: _OFFSET_U}.get(head, head) for head in range(len(HEADS))]
_ORIENTATIONS = [
    (mirrored_u, mirrored_u != other, transposed)
    for transposed in (False, True)
    for other in (False, True)
    for mirrored_u in (False, True)
]
"""Mirrored in u, mirrored in v, transposed; the first two are the picture as it is and turned by 180 degrees."""


def mean_answer(network: Callable[[Image], Image], picture: Image, orientations: int) -> Image:
    """Return the mean of a network's answers to a picture in its first orientations.

    Parameters
    ----------
    network : as :class:`~fluoromap.segmenter.electrodes.network.forward.ElectrodeNetwork`
    picture : (rows, columns) float32
    orientations : int
        1 to 8.

    Returns
    -------
    (rows / 2, columns / 2, heads) float32, in the orientation of the picture.
    """
    total: Image | None = None
    for mirrored_u, mirrored_v, transposed in _ORIENTATIONS[:orientations]:
        turned = _mirrored(picture, 1) if mirrored_u else picture
        turned = _mirrored(turned, 0) if mirrored_v else turned
        answers = network(np.ascontiguousarray(turned.T if transposed else turned))
        if transposed:
            answers = answers.transpose(1, 0, 2)[..., _TRANSPOSED]
        if mirrored_u:
            answers = answers[:, ::-1]
            answers[..., _OFFSET_U] *= -1.0
        if mirrored_v:
            answers = answers[::-1]
            answers[..., _OFFSET_V] *= -1.0
        total = answers if total is None else total + answers
    assert total is not None
    return total if orientations == 1 else total / np.float32(orientations)


def _mirrored(picture: Image, axis: int) -> Image:
    """Return a picture mirrored so that cells lie on cells.

    A cell answers for places around its first pixel, so the last row or column is repeated, not the first.
    """
    mirrored = np.flip(picture, axis)
    kept = np.take(mirrored, range(1, picture.shape[axis]), axis)
    return np.concatenate([kept, np.take(mirrored, [-1], axis)], axis)
