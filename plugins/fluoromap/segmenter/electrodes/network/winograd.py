"""Convolutions with windows of 3 x 3, by Winograd's minimal filtering F(4 x 4, 3 x 3).

A tile of 4 x 4 outputs takes 36 products of channels instead of 144 (Lavin and Gray 2016, "Fast algorithms for convolutional neural
networks"). Inputs and answers of a tile are transformed along columns and rows; between both, each of 36 places is one product of
matrices. All loops run over long stretches of memory: the columns of the padded picture are stored in four parts, every fourth
column of each, so that one column of all tiles of a row is contiguous.
"""

from __future__ import annotations

import numpy as np

from fluoromap.segmenter.electrodes.network.scratch_memory import ScratchMemory
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.log_image import Image

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
    pixels = _scratch.array("pixels", _TILE * across * bias.size)
    _split(x, dilation, padded)
    for first in range(0, tile_rows, strip):
        count = min(strip, tile_rows - first) * across
        tiles = _scratch.array("tiles", _PLACES, count, inputs)
        answers = _scratch.array("answers", _PLACES, count, bias.size)
        _transform_tiles(
            padded.reshape(-1), wide, down, first, lines, tiles.reshape(-1), count * inputs, across * inputs
        )
        np.matmul(tiles, places, out=answers)
        _join_tiles(answers.reshape(-1), count * bias.size, bias, dilation, down, first, lines, pixels, out)


def _split(x: Image, dilation: int, padded: Image) -> None:
    """Write all pixels to their places in the padded pictures (picture, row, column modulo 4, column / 4 x channels)."""
    whole_pixels = np.dtype((np.void, 4 * x.shape[2]))
    pixels, pictures = x.view(whole_pixels)[..., 0], padded.view(whole_pixels)
    for down in range(dilation):
        for right in range(dilation):
            picture = pictures[down * dilation + right, 1:]
            for column in range(_TILE):
                part = pixels[down::dilation, right + column * dilation :: _TILE * dilation]
                first = (column + 1) // _TILE
                picture[: part.shape[0], (column + 1) % _TILE, first : first + part.shape[1]] = part


@kernel("f4[::1], i8, i8, i8, f4[::1], f4[::1], i8, i8")
def _transform_tiles(padded, wide, down, first_row, lines, tiles, apart_tiles, size):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform rows of tiles along columns, then along rows.

    Each step transforms six stretches of memory to the six places. The first four stretches begin at ``start`` and are ``apart``,
    the others at ``after``. The places lie ``further`` from each other. All steps share their loops, because each loop costs a
    tenth of a second to compile. Indices are unsigned: checks for negative ones would keep the loops from running on several
    values at once.

    padded : all padded pictures, each with ``down`` rows of tiles. wide : length of a quarter of a row. lines : memory for what is
    transformed along columns only. apart_tiles : length of one place of all tiles. size : length of one place of a row of tiles.
    """
    row = 4 * wide
    for i in range(apart_tiles // size):
        picture, tile = (first_row + i) // down, (first_row + i) % down
        for step in range(7):
            if step == 0:
                source, start, apart = padded, (picture * (4 * down + 2) + 4 * tile) * row, row
                after, goal, place, further, count = start + 4 * row, lines, 0, row, row
            else:
                source, start, apart = lines, (step - 1) * row, wide
                after, goal, place = start + wide - size, tiles, 6 * (step - 1) * apart_tiles + i * size
                further, count = apart_tiles, size
            for end in range(2):
                p, a = np.uintp(place + 5 * end * further), np.uintp(start + end * apart)
                c, e = np.uintp(start + (2 + end) * apart), np.uintp(after + end * apart)
                for j in range(np.uintp(count)):
                    goal[p + j] = _PRODUCT * source[a + j] - _SUM * source[c + j] + source[e + j]
            b, c = np.uintp(start + apart), np.uintp(start + 2 * apart)
            d, e = np.uintp(start + 3 * apart), np.uintp(after)
            for middle in range(4):
                p = np.uintp(place + (1 + middle) * further)
                other = _B2 if middle < 2 else _A2
                point = (_A1 if middle < 2 else _B1) * np.float32(1 - 2 * (middle % 2))
                for j in range(np.uintp(count)):
                    goal[p + j] = (
                        source[e + j] - other * source[c + j] + point * (source[d + j] - other * source[b + j])
                    )


@kernel("f4[::1], i8, f4[::1], i8, i8, i8, f4[::1], f4[::1], f4[:,:,::1]")
def _join_tiles(answers, apart_answers, bias, dilation, down, first_row, lines, pixels, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Transform the answers of rows of tiles back to pixels.

    First along columns, then along rows. Each step transforms six stretches of memory, ``apart`` from each other, to four that
    follow each other. The bias is added and negative values become 0.

    apart_answers : length of one place of all tiles. lines, pixels : memory for steps between.
    """
    channels, size = bias.size, pixels.size // 4
    zero = np.float32(0)
    for i in range(apart_answers // size):
        part, tile = (first_row + i) // down, (first_row + i) % down
        for step in range(10):
            v = (4 * tile + step - 6) * dilation + part // dilation
            if step < 6:
                source, start, apart = answers, step * apart_answers + i * size, 6 * apart_answers
                goal, place = lines, 4 * step * size
            elif v < out.shape[0]:
                source, start, apart = lines, (step - 6) * size, 4 * size
                goal, place = pixels, 0
            else:
                break
            b, c = np.uintp(start + apart), np.uintp(start + 2 * apart)
            d, e = np.uintp(start + 3 * apart), np.uintp(start + 4 * apart)
            for end in range(2):
                p, alone = np.uintp(place + 3 * end * size), np.uintp(start + 5 * end * apart)
                near, far, sign = (_A3, _B3, -_ONE) if end else (_ONE, _ONE, _ONE)
                for j in range(np.uintp(size)):
                    goal[p + j] = (
                        near * (source[b + j] + sign * source[c + j])
                        + far * (source[d + j] + sign * source[e + j])
                        + source[alone + j]
                    )
            for middle in range(2):
                p = np.uintp(place + (1 + middle) * size)
                near, far, sign = (_A2, _B2, _ONE) if middle else (_A1, _B1, -_ONE)
                for j in range(np.uintp(size)):
                    goal[p + j] = near * (source[b + j] + sign * source[c + j]) + far * (
                        source[d + j] + sign * source[e + j]
                    )
            if step < 6:
                continue
            for column, u in enumerate(range(part % dilation, out.shape[1], dilation)):
                begin = column % 4 * size + column // 4 * channels
                pixel, target = pixels[begin : begin + channels], out[v, u]
                for k in range(channels):
                    target[k] = max(pixel[k] + bias[k], zero)
