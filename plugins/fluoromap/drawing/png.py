"""PNG files of pictures (ISO/IEC 15948).

Pillow tries every filter on each line, which takes longer than the compression. A line of a fluoroscopy frame is like the
line above it, so that one filter suits all lines. Writing the file here takes half the time, for a file of the same size.
"""

from __future__ import annotations

import struct
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREY, RGB = 0, 2
"""Colour types."""

ZLIB_HEADER = b"\x78\x01"
"""Deflate with a window of 32 KiB, compressed fast (RFC 1950 section 2.2)."""

HALVED_BYTES = 1 << 19
"""Size from which a second processor saves more than its start costs."""

UP = 2
"""The filter that stores the difference of each byte from the byte above it."""


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """Encode a picture, (rows, columns) grey or (rows, columns, 3) RGB, as PNG; the same picture gives the same bytes.

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
    # Noise hardly compresses. A grey frame has no repetitions, so a search for them would double time and enlarge the file. In
    # colours a higher level takes up to twice as long and saves a tenth.
    strategy = zlib.Z_HUFFMAN_ONLY if grey else zlib.Z_DEFAULT_STRATEGY
    content = _zlib_stream(lines.ravel().data, strategy)
    return SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", content) + _chunk(b"IEND", b"")


def _zlib_stream(content: memoryview, strategy: int) -> bytes:
    """Compress bytes into a zlib stream (RFC 1950).

    Two threads compress the halves of a large picture. The first half ends at a whole byte, and the second one does not
    refer to it, so that together they are one stream.
    """
    middle = len(content) // 2 if len(content) >= HALVED_BYTES else 0

    def compress(part: memoryview, end: int) -> bytes:
        stream = zlib.compressobj(2, zlib.DEFLATED, -zlib.MAX_WBITS, strategy=strategy)
        return stream.compress(part) + stream.flush(end)

    with ThreadPoolExecutor(1) as thread:
        first = thread.submit(compress, content[:middle], zlib.Z_FULL_FLUSH) if middle else None
        second = compress(content[middle:], zlib.Z_FINISH)
        body = second if first is None else first.result() + second
    return ZLIB_HEADER + body + struct.pack(">I", zlib.adler32(content))


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(content, zlib.crc32(kind)))
