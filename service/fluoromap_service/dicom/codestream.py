"""One compressed frame: its header, and its pixels."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydicom.encaps import encapsulate
from pydicom.pixels.decoders.base import get_decoder
from pydicom.uid import JPEGExtended12Bit

from fluoromap_service.dicom.errors import DicomCode, dicom_problem
from fluoromap_service.dicom.pixel_layout import JP2_SIGNATURE, JPEG_2000, JPEG_LS, RLE, PixelLayout, syntax_name
from fluoromap_service.problem import Problem

Pixels = NDArray[np.unsignedinteger[Any]]

_MOST_TILES = 4096
_SLACK_BYTES = 65_536

# JPEG markers: SOF0 to SOF15 (without DHT, JPG and DAC) and SOF55 of JPEG-LS; DHT, DAC, DQT, DRI and LSE; APPn and COM.
_FRAME_HEADERS = frozenset({*range(0xC0, 0xD0), 0xF7} - {0xC4, 0xC8, 0xCC})
_TABLES = frozenset({0xC4, 0xCC, 0xDB, 0xDD, 0xF8})
_NOTES = frozenset({*range(0xE0, 0xF0), 0xFE})
_START_OF_SCAN = 0xDA


@dataclass(frozen=True, slots=True)
class Codestream:
    """The size of a compressed image by its own header."""

    rows: int
    columns: int
    precision: int
    components: int


def largest_codestream(layout: PixelLayout) -> int:
    """Return the largest plausible size of a compressed frame in bytes.

    It is twice its pixels, and some for headers.
    """
    return 2 * layout.frame_bytes + _SLACK_BYTES


def decode(layout: PixelLayout, codestream: bytes) -> Pixels:
    """Return the pixels of one compressed frame, (rows, columns) uint8 or uint16 by BitsAllocated, writable.

    The function first compares the codestream's own size with the header's. So a few bytes that claim gigabytes allocate
    nothing.

    Raises
    ------
    Problem
        ``pixel_data_mismatch`` or ``undecodable``.
    """
    if layout.transfer_syntax in RLE:
        return _decode_rle(layout, codestream)
    parsed = _parse(layout, codestream)
    if parsed is None:
        raise _undecodable(layout, "its codestream has no valid header")
    described, essential = parsed
    if (described.rows, described.columns, described.components) != (layout.rows, layout.columns, 1):
        raise dicom_problem(
            DicomCode.PIXEL_DATA_MISMATCH,
            f"The compressed frame is {described.columns} x {described.rows} pixels with {described.components} components, "
            f"but the header announces {layout.columns} x {layout.rows} with 1.",
            "PixelData",
        )
    if layout.transfer_syntax == JPEGExtended12Bit and described.precision > 8:
        raise dicom_problem(
            DicomCode.UNDECODABLE,
            f"{syntax_name(JPEGExtended12Bit)} with {described.precision} bits a pixel cannot be decoded; "
            "send uncompressed, JPEG Lossless or JPEG 2000.",
            "TransferSyntaxUID",
        )
    if described.precision > layout.bits_allocated:
        raise dicom_problem(
            DicomCode.PIXEL_DATA_MISMATCH,
            f"The compressed frame has {described.precision} bits a pixel, but BitsAllocated is {layout.bits_allocated}; "
            "export the run again.",
            "BitsAllocated",
        )
    if described.precision < 1:
        raise _undecodable(layout, "its pixels have no bits")
    options: dict[str, Any] = {
        "rows": layout.rows,
        "columns": layout.columns,
        "number_of_frames": 1,
        "samples_per_pixel": 1,
        # GDCM sizes its pixels by the codestream, not by BitsAllocated and BitsStored.
        "bits_allocated": 8 if described.precision <= 8 else 16,
        "bits_stored": described.precision,
        "pixel_representation": 0,
        "photometric_interpretation": "MONOCHROME2",
        "pixel_keyword": "PixelData",
    }
    gdcm_fails = layout.transfer_syntax in JPEG_LS and described.precision in (6, 7)
    options["decoding_plugin"] = "pyjpegls" if gdcm_fails else "gdcm"
    try:
        decoder = get_decoder(layout.transfer_syntax)
        pixels, _ = decoder.as_array(encapsulate([essential]), index=0, raw=True, **options)
    except Exception as error:
        raise _undecodable(layout, "the decoder fails") from error
    if pixels.shape != (layout.rows, layout.columns) or pixels.dtype.kind != "u":
        raise _undecodable(layout, "the decoder returned another size or type of pixels")
    return np.require(pixels, f"<u{layout.bits_allocated // 8}", ["C", "W"])


def _undecodable(layout: PixelLayout, why: str) -> Problem:
    return dicom_problem(
        DicomCode.UNDECODABLE,
        f"A frame in {syntax_name(layout.transfer_syntax)} does not decode: {why}; export the run again.",
        "PixelData",
    )


def _parse(layout: PixelLayout, codestream: bytes) -> tuple[Codestream, bytes] | None:
    """Return the codestream's header and the bytes for the decoder; None when the header is damaged."""
    try:
        if layout.transfer_syntax not in JPEG_2000:
            return _parse_jpeg(codestream)
        codestream = _without_boxes(codestream)
        described = _parse_jpeg_2000(codestream)
    except (struct.error, IndexError):
        return None
    return (described, codestream) if described else None


def _parse_jpeg(codestream: bytes) -> tuple[Codestream, bytes] | None:
    """Parse the marker segments up to the first scan, ITU-T T.81 annex B (T.87 for JPEG-LS).

    The decoder gets only the segments that pixels depend on, with nothing between them. Stray bytes or an odd JFIF or Adobe
    segment make GDCM's JPEG library warn, and then an uncaught exception ends the whole process.
    """
    if codestream[:2] != b"\xff\xd8":
        return None
    essential = [codestream[:2]]
    described: Codestream | None = None
    position = 2
    while codestream[position] == 0xFF:
        marker = codestream[position + 1]
        if marker == 0xFF:
            position += 1
            continue
        (length,) = struct.unpack_from(">H", codestream, position + 2)
        if marker in _FRAME_HEADERS:
            precision, rows, columns, components = struct.unpack_from(">BHHB", codestream, position + 4)
            described = Codestream(rows, columns, precision, components)
        elif marker == _START_OF_SCAN:
            return (described, b"".join(essential) + codestream[position:]) if described else None
        if marker in _FRAME_HEADERS or marker in _TABLES:
            essential.append(codestream[position : position + 2 + length])
        elif marker not in _NOTES:
            return None
        position += 2 + length
    return None


def _without_boxes(content: bytes) -> bytes:
    """Return the codestream of a JP2 file; other content is returned unchanged.

    The boxes are those of ITU-T T.800 annex I.4. PS3.5 A.4.4 allows the codestream only. Some systems put a whole
    JP2 file into a frame.
    """
    if not content.startswith(JP2_SIGNATURE):
        return content
    position = 0
    while position < len(content):
        length, kind = struct.unpack_from(">L4s", content, position)
        header = 8
        if length == 1:
            (length,) = struct.unpack_from(">Q", content, position + 8)
            header = 16
        end = len(content) if length == 0 else position + length
        if kind == b"jp2c":
            return content[position + header : end]
        # A box that is shorter than its header would lead nowhere.
        position = max(end, position + header)
    return content


def _parse_jpeg_2000(codestream: bytes) -> Codestream | None:
    """Parse the SIZ marker segment of ITU-T T.800 A.5.1.

    It comes first in a bare codestream.
    """
    if codestream[:4] != b"\xff\x4f\xff\x51":
        return None
    x1, y1, x0, y0, tile_width, tile_height, _, _, components, depth, dx, dy = struct.unpack_from(
        ">8LHBBB", codestream, 8
    )
    if not (tile_width and tile_height and dx == dy == 1 and depth < 128 and x1 > x0 and y1 > y0):
        return None
    if -(-x1 // tile_width) * -(-y1 // tile_height) > _MOST_TILES:
        return None
    return Codestream(y1 - y0, x1 - x0, depth + 1, components)


def _decode_rle(layout: PixelLayout, codestream: bytes) -> Pixels:
    """Decode RLE of PS3.5 annex G.

    There is one segment for each byte plane, the most significant first. pydicom's decoder expands a segment fully
    before it checks the frame's size; this one stops at that size.
    """
    planes = layout.bits_allocated // 8
    if len(codestream) < 64:
        raise _undecodable(layout, "its RLE header ends too early")
    count, *offsets = struct.unpack_from("<16L", codestream)
    bounds = [*offsets[:planes], len(codestream)]
    if count != planes or bounds != sorted(bounds) or bounds[0] < 64:
        raise _undecodable(layout, "its RLE header does not fit BitsAllocated")
    size = layout.rows * layout.columns
    pixels = np.empty((size, planes), dtype=np.uint8)
    for plane in range(planes):
        segment = _unpack_bits(codestream[bounds[plane] : bounds[plane + 1]], size)
        if len(segment) != size:
            raise _undecodable(layout, "an RLE segment does not hold one frame")
        pixels[:, planes - 1 - plane] = np.frombuffer(segment, dtype=np.uint8)
    return pixels.view("<u2" if planes == 2 else "u1").reshape(layout.rows, layout.columns)


def _unpack_bits(segment: bytes, size: int) -> bytearray:
    """Return at most ``size`` bytes of one segment, PS3.5 G.3.2."""
    unpacked = bytearray()
    position, end = 0, len(segment)
    while position < end and len(unpacked) < size:
        control = segment[position]
        position += 1
        if control < 128:
            unpacked += segment[position : position + control + 1]
            position += control + 1
        elif control > 128:
            unpacked += segment[position : position + 1] * (257 - control)
            position += 1
    return unpacked[:size]
