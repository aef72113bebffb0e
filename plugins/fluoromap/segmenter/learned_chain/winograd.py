"""Convolutions with windows of 3 x 3, by Winograd's minimal filtering F(4 x 4, 3 x 3).

A tile of 4 x 4 outputs takes 36 products of channels instead of 144 (Lavin and Gray 2016, "Fast algorithms for convolutional neural
networks"). Inputs and answers of a tile are transformed along columns and rows; between both, each of 36 places is one product of
matrices. All loops run over long stretches of memory: the columns of the padded picture are stored in four parts, every fourth
column of each, so that one column of all tiles of a row is contiguous.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fluoromap.segmenter.learned_chain.scratch_memory import ScratchMemory
from fluoromap.segmenter.log_image import Image

_TILE = 4
_PLACES = 36
_STRIP_TILES = 108
_A, _B = 5 / 8, 3 / 2
"""The points 0, +-A, +-B and infinity, at which polynomials are multiplied.

Rounding errors are smaller than with 1 and 2 (Barabasz et al. 2020, "Error analysis and improving the accuracy of
Winograd convolution for deep neural networks").
"""
_AT_A, _AT_B = 1 / (2 * _A**2 * (_A**2 - _B**2)), 1 / (2 * _B**2 * (_B**2 - _A**2))
_TAPS = np.array(
    [
        [1 / (_A * _B) ** 2, 0, 0],
        [_AT_A, _A * _AT_A, _A**2 * _AT_A],
        [_AT_A, -_A * _AT_A, _A**2 * _AT_A],
        [_AT_B, _B * _AT_B, _B**2 * _AT_B],
        [_AT_B, -_B * _AT_B, _B**2 * _AT_B],
        [0, 0, 1],
    ]
)
_A1, _A2, _A3 = (np.float32(_A**power) for power in (1, 2, 3))
_B1, _B2, _B3 = (np.float32(_B**power) for power in (1, 2, 3))
_ONE = np.float32(1)
_SUM, _PRODUCT = np.float32(_A**2 + _B**2), np.float32((_A * _B) ** 2)

_scratch = ScratchMemory()


def transformed_taps(taps: Image) -> Image:
    """Return the taps of a window, (9, inputs, outputs), for the 36 places of a tile, (36, inputs, outputs)."""
    windows = taps.astype(np.float64).reshape(3, 3, *taps.shape[1:])
    places = np.einsum("ai,bj,ijkl->abkl", _TAPS, _TAPS, windows)
    return np.ascontiguousarray(places.reshape(_PLACES, *taps.shape[1:]), np.float32)


def convolve(x: Image, places: Image, bias: Image, dilation: int, out: Image) -> None:
    """Write the rectified convolution of (rows, columns, inputs) into (rows, columns, outputs).

    ``places`` : see :func:`transformed_taps`. Pixels outside count 0. With a dilation, every ``dilation``-th row and column are a
    picture of their own.
    """
    rows, columns, inputs = x.shape
    down, across = (-(-size // (dilation * _TILE)) for size in (rows, columns))
    strip = max(1, _STRIP_TILES // across)
    tile_rows = dilation**2 * down
    wide = (across + 1) * inputs
    padded = _scratch.around(f"padded {dilation} {inputs}", x.shape, dilation**2, _TILE * down + 2, _TILE, wide)
    lines = _scratch.array("lines", 6 * _TILE * (across + 1) * max(inputs, bias.size))
    _split(x, dilation, padded)
    for first in range(0, tile_rows, strip):
        count = min(strip, tile_rows - first) * across
        tiles = _scratch.array("tiles", _PLACES, count, inputs)
        answers = _scratch.array("answers", _PLACES, count, bias.size)
        _transform_tiles(
            padded.reshape(dilation**2, -1, _TILE * wide), inputs, first, lines, tiles.reshape(_PLACES, -1)
        )
        np.matmul(tiles, places, out=answers)
        _join_tiles(answers.reshape(_PLACES, -1), bias, dilation, across, first, lines, out)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _split(x, dilation, padded):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write all pixels to their places in the padded pictures (picture, row, column modulo 4, column / 4 x channels)."""
    channels = x.shape[2]
    for v in range(x.shape[0]):
        line = x[v]
        for part in range(dilation):
            target = padded[v % dilation * dilation + part, v // dilation + 1]
            for column, u in enumerate(range(part, x.shape[1], dilation)):
                first = (column + 1) // 4 * channels
                goal = target[(column + 1) % 4][first : first + channels]
                pixel = line[u]
                for k in range(channels):
                    goal[k] = pixel[k]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _transform_tiles(padded, channels, first_row, lines, tiles):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform rows of tiles along columns, then along rows.

    ``lines`` : memory for what is transformed along columns only.
    """
    row = padded.shape[2]
    wide = row // 4
    size = wide - channels
    down = padded.shape[1] // 4
    pictures, places = padded.reshape(-1), tiles.reshape(-1)
    for i in range(tiles.shape[1] // size):
        picture, tile = (first_row + i) // down, (first_row + i) % down
        above = (picture * padded.shape[1] + 4 * tile) * row
        _transform(pictures, above, row, above + 4 * row, lines, row, row)
        for k in range(6):
            goal = places[6 * k * tiles.shape[1] + i * size :]
            _transform(lines, k * row, wide, k * row + channels, goal, tiles.shape[1], size)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _transform(source, start, apart, after, goal, further, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform six stretches of ``source`` to the six places.

    The first four stretches begin at ``start`` and are ``apart``, the others at ``after``. The places lie ``further`` from each
    other. Indices are unsigned: checks for negative ones would keep the loops from running on several values at once.
    """
    size = np.uintp(count)
    for end in range(2):
        place, a = np.uintp(5 * end * further), np.uintp(start + end * apart)
        c, e = np.uintp(start + (2 + end) * apart), np.uintp(after + end * apart)
        for j in range(size):
            goal[place + j] = _PRODUCT * source[a + j] - _SUM * source[c + j] + source[e + j]
    b, c = np.uintp(start + apart), np.uintp(start + 2 * apart)
    d, e = np.uintp(start + 3 * apart), np.uintp(after)
    for middle in range(4):
        place = np.uintp((1 + middle) * further)
        other = _B2 if middle < 2 else _A2
        point = (_A1 if middle < 2 else _B1) * np.float32(1 - 2 * (middle % 2))
        for j in range(size):
            goal[place + j] = source[e + j] - other * source[c + j] + point * (source[d + j] - other * source[b + j])


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _join_tiles(answers, bias, dilation, across, first_row, lines, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform the answers of rows of tiles back to pixels.

    The bias is added and negative values become 0.
    """
    channels = bias.size
    size = across * channels
    down = (out.shape[0] + 4 * dilation - 1) // (4 * dilation)
    places, pixels = answers.reshape(-1), np.empty(4 * size, np.float32)
    zero = np.float32(0)
    for i in range(answers.shape[1] // size):
        part, tile = (first_row + i) // down, (first_row + i) % down
        for k in range(6):
            _transform_back(places, k * answers.shape[1] + i * size, 6 * answers.shape[1], lines[4 * k * size :], size)
        for s in range(4):
            v = (4 * tile + s) * dilation + part // dilation
            if v >= out.shape[0]:
                break
            _transform_back(lines, s * size, 4 * size, pixels, size)
            for column, u in enumerate(range(part % dilation, out.shape[1], dilation)):
                begin = column % 4 * size + column // 4 * channels
                pixel, target = pixels[begin : begin + channels], out[v, u]
                for k in range(channels):
                    target[k] = max(pixel[k] + bias[k], zero)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _transform_back(source, start, apart, goal, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform six stretches of ``source`` to four pixels.

    The stretches are ``apart``. The pixels follow each other in ``goal``.
    """
    size = np.uintp(count)
    b, c = np.uintp(start + apart), np.uintp(start + 2 * apart)
    d, e = np.uintp(start + 3 * apart), np.uintp(start + 4 * apart)
    for end in range(2):
        pixel, alone = np.uintp(3 * end * count), np.uintp(start + 5 * end * apart)
        near, far, sign = (_A3, _B3, -_ONE) if end else (_ONE, _ONE, _ONE)
        for j in range(size):
            goal[pixel + j] = (
                near * (source[b + j] + sign * source[c + j])
                + far * (source[d + j] + sign * source[e + j])
                + source[alone + j]
            )
    for middle in range(2):
        pixel = np.uintp((1 + middle) * count)
        near, far, sign = (_A2, _B2, _ONE) if middle else (_A1, _B1, -_ONE)
        for j in range(size):
            goal[pixel + j] = near * (source[b + j] + sign * source[c + j]) + far * (
                source[d + j] + sign * source[e + j]
            )
