"""PNG files of pictures (ISO/IEC 15948).

Written here because Pillow tries every filter on each line, which takes longer than compressing it: a line of a fluoroscopy
frame is like the one above it, so that one filter does for all, in half the time and to a file as small.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREY, RGB = 0, 2
"""Colour types."""

UP = 2
"""The filter that keeps of each byte the difference to the one above it."""


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """PNG of a picture, (rows, columns) grey or (rows, columns, 3) RGB; the same picture gives the same bytes.

    Raises
    ------
    ValueError
        When it is neither, not of 8 bits, or empty.
    """
    grey = picture.ndim == 2
    if picture.dtype != np.uint8 or not (grey or picture.shape[2:] == (3,)) or picture.size == 0:
        raise ValueError(f"a picture is uint8, grey or RGB, and not empty; this one is {picture.dtype} {picture.shape}")
    rows, columns = picture.shape[:2]
    flat = picture.reshape(rows, -1)
    lines = np.empty((rows, 1 + flat.shape[1]), dtype=np.uint8)
    lines[:, 0] = UP
    lines[0, 1:] = flat[0]
    np.subtract(flat[1:], flat[:-1], out=lines[1:, 1:])
    header = struct.pack(">2I5B", columns, rows, 8, GREY if grey else RGB, 0, 0, 0)
    # Noise does not compress: more effort takes up to twice as long and saves a tenth.
    content = zlib.compress(lines.tobytes(), level=2)
    return SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", content) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(content, zlib.crc32(kind)))
