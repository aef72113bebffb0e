"""PNG files of pictures (ISO/IEC 15948).

Pillow tries every filter on each line, which takes longer than the compression. A line of a fluoroscopy frame is like the
line above it, so that one filter suits all lines. ISA-L compresses as well as zlib, in less time.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREY, RGB = 0, 2
"""Colour types."""

UP = 2
"""The filter that stores the difference of each byte from the byte above it."""

LEVEL = 1
"""Compression level. Noise hardly compresses: higher levels take longer and save nothing."""


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """Encode a picture, (rows, columns) grey or (rows, columns, 3) RGB, as PNG; the same picture gives the same bytes.

    Another kind of processor may compress it to other bytes.

    Raises
    ------
    ValueError
        Where the picture has another shape, does not have 8 bits, or is empty.
    """
    grey = picture.ndim == 2
    if picture.dtype != np.uint8 or not (grey or picture.shape[2:] == (3,)) or picture.size == 0:
        raise ValueError(f"a picture must be uint8, grey or RGB, and not empty, not {picture.dtype} {picture.shape}")
    rows, columns = picture.shape[:2]
    flat = picture.reshape(rows, -1)
    lines = np.empty((rows, 1 + flat.shape[1]), dtype=np.uint8)
    lines[:, 0] = UP
    lines[0, 1:] = flat[0]
    np.subtract(flat[1:], flat[:-1], out=lines[1:, 1:])
    header = struct.pack(">2I5B", columns, rows, 8, GREY if grey else RGB, 0, 0, 0)
    content = isal_zlib.compress(lines.ravel(), LEVEL)
    return SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", content) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(content, zlib.crc32(kind)))
