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
def _transform(a, b, c, d, e, f, first, second, third, fourth, fifth, sixth):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform six inputs to the six places."""
    for j in range(first.size):
        first[j] = _PRODUCT * a[j] - _SUM * c[j] + e[j]
    for j in range(first.size):
        second[j] = e[j] - _B2 * c[j] + _A1 * (d[j] - _B2 * b[j])
    for j in range(first.size):
        third[j] = e[j] - _B2 * c[j] - _A1 * (d[j] - _B2 * b[j])
    for j in range(first.size):
        fourth[j] = e[j] - _A2 * c[j] + _B1 * (d[j] - _A2 * b[j])
    for j in range(first.size):
        fifth[j] = e[j] - _A2 * c[j] - _B1 * (d[j] - _A2 * b[j])
    for j in range(first.size):
        sixth[j] = _PRODUCT * b[j] - _SUM * d[j] + f[j]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _transform_tiles(padded, channels, first_row, lines, tiles):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform rows of tiles along columns, then along rows."""
    row = padded.shape[2]
    wide = row // 4
    size = wide - channels
    down = padded.shape[1] // 4
    for i in range(tiles.shape[1] // size):
        part, v = padded[(first_row + i) // down], 4 * ((first_row + i) % down)
        _transform(
            part[v], part[v + 1], part[v + 2], part[v + 3], part[v + 4], part[v + 5],
            lines[:row], lines[row : 2 * row], lines[2 * row : 3 * row], lines[3 * row : 4 * row],
            lines[4 * row : 5 * row], lines[5 * row : 6 * row],
        )  # fmt: skip
        at, to = i * size, (i + 1) * size
        for k in range(6):
            line = lines[k * row : (k + 1) * row]
            p = 6 * k
            _transform(
                line[:size], line[wide : wide + size], line[2 * wide : 2 * wide + size],
                line[3 * wide : 3 * wide + size], line[channels : channels + size],
                line[wide + channels : wide + channels + size],
                tiles[p][at:to], tiles[p + 1][at:to], tiles[p + 2][at:to], tiles[p + 3][at:to], tiles[p + 4][at:to],
                tiles[p + 5][at:to],
            )  # fmt: skip


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _transform_back(a, b, c, d, e, f, first, second, third, fourth):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform the six places to the four outputs."""
    for j in range(first.size):
        first[j] = a[j] + (b[j] + c[j]) + (d[j] + e[j])
    for j in range(first.size):
        second[j] = _A1 * (b[j] - c[j]) + _B1 * (d[j] - e[j])
    for j in range(first.size):
        third[j] = _A2 * (b[j] + c[j]) + _B2 * (d[j] + e[j])
    for j in range(first.size):
        fourth[j] = _A3 * (b[j] - c[j]) + _B3 * (d[j] - e[j]) + f[j]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _join_tiles(answers, bias, dilation, across, first_row, lines, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform the answers of rows of tiles back to pixels.

    The bias is added and negative values become 0.
    """
    channels = bias.size
    size = across * channels
    down = (out.shape[0] + 4 * dilation - 1) // (4 * dilation)
    pixels = np.empty((4, size), np.float32)
    zero = np.float32(0)
    for i in range(answers.shape[1] // size):
        at, to = i * size, (i + 1) * size
        for k in range(6):
            p = 4 * k * size
            _transform_back(
                answers[k][at:to], answers[k + 6][at:to], answers[k + 12][at:to], answers[k + 18][at:to],
                answers[k + 24][at:to], answers[k + 30][at:to],
                lines[p : p + size], lines[p + size : p + 2 * size], lines[p + 2 * size : p + 3 * size],
                lines[p + 3 * size : p + 4 * size],
            )  # fmt: skip
        part = (first_row + i) // down
        for s in range(4):
            v = (4 * ((first_row + i) % down) + s) * dilation + part // dilation
            if v >= out.shape[0]:
                break
            p = s * size
            _transform_back(
                lines[p : p + size], lines[p + 4 * size : p + 5 * size], lines[p + 8 * size : p + 9 * size],
                lines[p + 12 * size : p + 13 * size], lines[p + 16 * size : p + 17 * size],
                lines[p + 20 * size : p + 21 * size],
                pixels[0], pixels[1], pixels[2], pixels[3],
            )  # fmt: skip
            row = out[v]
            for column, u in enumerate(range(part % dilation, out.shape[1], dilation)):
                first = column // 4 * channels
                source, target = pixels[column % 4][first : first + channels], row[u]
                for k in range(channels):
                    target[k] = max(source[k] + bias[k], zero)
