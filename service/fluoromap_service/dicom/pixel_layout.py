"""The place of each frame in its file, checked against the file's bytes without decoding or loading pixels."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from io import BufferedReader

from pydicom import uid

from fluoromap_service.dicom.errors import DicomCode, dicom_problem
from fluoromap_service.dicom.facts import HeaderWarning, is_uid
from fluoromap_service.dicom.header import UNDEFINED_LENGTH, Header, truncation_problem
from fluoromap_service.problem import Problem

LARGEST_SIDE = 8192
MOST_FRAMES = 20_000

NATIVE = frozenset(
    {
        uid.ExplicitVRLittleEndian,
        uid.ImplicitVRLittleEndian,
        uid.DeflatedExplicitVRLittleEndian,
        uid.ExplicitVRBigEndian,
    }
)
JPEG = frozenset({uid.JPEGBaseline8Bit, uid.JPEGExtended12Bit, uid.JPEGLossless, uid.JPEGLosslessSV1})
JPEG_LS = frozenset({uid.JPEGLSLossless, uid.JPEGLSNearLossless})
JPEG_2000 = frozenset({uid.JPEG2000Lossless, uid.JPEG2000})
RLE = frozenset({uid.RLELossless})
DECODABLE = NATIVE | JPEG | JPEG_LS | JPEG_2000 | RLE

JP2_SIGNATURE = b"\x00\x00\x00\x0cjP  \r\n\x87\n"
"""The first box of a JP2 file, ITU-T T.800 I.5.1."""
_MOST_FRAGMENTS = 200_000
_ITEM, _DELIMITER = (0xFFFE, 0xE000), (0xFFFE, 0xE0DD)

Extent = tuple[int, int]
"""(offset, length) of bytes in the file."""


@dataclass(frozen=True, slots=True)
class PixelLayout:
    """Size and encoding of the frames, and the place of each.

    Parameters
    ----------
    rows, columns, frames : int
    bits_allocated, bits_stored : int
        By the header.
    transfer_syntax : str
    extents : tuple of tuple of Extent
        For each frame its pieces of the file, in order.
    big_endian_words : bool
        Whether the bytes of each 16-bit word lie in the other order, also where a word holds two 8-bit pixels
        (PS3.5 section A.3 and annex D).
    overlay_bits : int
        Mask of the bits of a pixel cell that are overlay planes and no pixel.
    """

    rows: int
    columns: int
    frames: int
    bits_allocated: int
    bits_stored: int
    transfer_syntax: str
    extents: tuple[tuple[Extent, ...], ...]
    big_endian_words: bool = False
    overlay_bits: int = 0

    @property
    def frame_bytes(self) -> int:
        """Bytes of one decoded frame."""
        return self.rows * self.columns * self.bits_allocated // 8


def syntax_name(transfer_syntax: str) -> str:
    """Return the name of a transfer syntax for messages; the UID where the syntax is unknown."""
    return uid.UID(transfer_syntax).name if is_uid(transfer_syntax) else "no valid UID"


def pixel_layout(file: BufferedReader, header: Header, warnings: list[HeaderWarning]) -> PixelLayout:
    """Check the header against the bytes of the file, and find every frame.

    Raises
    ------
    Problem
        ``malformed``, ``frame_too_large``, ``too_many_frames``, ``unsupported_pixels``, ``undecodable``, ``no_pixel_data``,
        ``truncated`` or ``pixel_data_mismatch``.

    References
    ----------
    PS3.3 C.7.6.3 (image pixel module), PS3.5 section 8 and annex A.4 (encapsulation).
    """
    syntax = header.transfer_syntax
    if syntax not in DECODABLE:
        raise _undecodable_syntax(syntax)
    rows, columns, frames = _size(header)
    bits_allocated, bits_stored = _bits(header)
    element = header.pixel_element
    if element is None or element.length == 0:
        raise dicom_problem(
            DicomCode.NO_PIXEL_DATA, "The object has no image (no PixelData); send a run with pixels.", "PixelData"
        )
    swapped = syntax == uid.ExplicitVRBigEndian and (bits_allocated == 16 or element.vr == "OW")
    overlays = _overlay_bits(header, bits_stored, bits_allocated)
    layout = PixelLayout(rows, columns, frames, bits_allocated, bits_stored, syntax, (), swapped, overlays)
    if syntax in NATIVE:
        extents = _native_extents(header, frames, layout.frame_bytes, warnings)
    else:
        extents = _group(file, _fragments(file, header), layout, warnings)
    return replace(layout, extents=extents)


def _undecodable_syntax(syntax: str) -> Problem:
    # A video is one stream of all frames: MPEG-2, MPEG-4, HEVC, PS3.5 section 10.
    kind = "video" if uid.UID(syntax) in uid.MPEGTransferSyntaxes else "image"
    return dicom_problem(
        DicomCode.UNDECODABLE,
        f"The service cannot decode this {kind}: its transfer syntax is {syntax_name(syntax)}; "
        "send the frames uncompressed or as RLE, JPEG, JPEG-LS or JPEG 2000.",
        "TransferSyntaxUID",
    )


def _overlay_bits(header: Header, bits_stored: int, bits_allocated: int) -> int:
    """Return the bits of a pixel cell that hold overlay planes, as a mask.

    Retired in PS3.5 section 8.1.2: an overlay is in a bit above BitsStored, and OverlayBitPosition (60xx,0102) names it.
    """
    return sum(1 << bit for bit in header.overlay_bits() if bits_stored <= bit < bits_allocated)


def _size(header: Header) -> tuple[int, int, int]:
    rows, columns = (_count(header, keyword) for keyword in ("Rows", "Columns"))
    frames = _count(header, "NumberOfFrames") if header.holds("NumberOfFrames") else 1
    if max(rows, columns) > LARGEST_SIDE:
        raise dicom_problem(
            DicomCode.FRAME_TOO_LARGE,
            f"The frames are larger than {LARGEST_SIDE} pixels a side; send a smaller matrix.",
            "Rows",
        )
    if frames > MOST_FRAMES:
        raise dicom_problem(
            DicomCode.TOO_MANY_FRAMES,
            f"The run has more than {MOST_FRAMES} frames; send a shorter one.",
            "NumberOfFrames",
        )
    return rows, columns, frames


def _count(header: Header, keyword: str) -> int:
    value = header.integer(keyword)
    if value is None or value < 1:
        raise dicom_problem(
            DicomCode.MALFORMED, f"{keyword} is missing or not a positive number; export the run again.", keyword
        )
    return value


def _bits(header: Header) -> tuple[int, int]:
    if header.integer("SamplesPerPixel") not in (1, None) or header.text("PhotometricInterpretation") not in (
        "MONOCHROME1",
        "MONOCHROME2",
    ):
        raise dicom_problem(
            DicomCode.UNSUPPORTED_PIXELS,
            "The image is not greyscale; send MONOCHROME1 or MONOCHROME2.",
            "PhotometricInterpretation",
        )
    allocated = header.integer("BitsAllocated")
    if allocated not in (8, 16):
        raise dicom_problem(
            DicomCode.UNSUPPORTED_PIXELS,
            "The pixels have neither 8 nor 16 bits; set BitsAllocated to one of these.",
            "BitsAllocated",
        )
    stored = header.integer("BitsStored") or allocated
    if not 1 <= stored <= allocated or header.integer("HighBit") not in (stored - 1, None):
        raise dicom_problem(
            DicomCode.UNSUPPORTED_PIXELS,
            "BitsStored and HighBit do not fit BitsAllocated; export the run again.",
            "BitsStored",
        )
    if header.integer("PixelRepresentation") not in (0, None):
        raise dicom_problem(
            DicomCode.UNSUPPORTED_PIXELS, "The pixels are signed; send unsigned pixels.", "PixelRepresentation"
        )
    return allocated, stored


def _mismatch(message: str, where: str = "NumberOfFrames") -> Problem:
    return dicom_problem(DicomCode.PIXEL_DATA_MISMATCH, message, where)


def _native_extents(
    header: Header, frames: int, frame_bytes: int, warnings: list[HeaderWarning]
) -> tuple[tuple[Extent, ...], ...]:
    element = header.pixel_element
    assert element is not None
    announced = frames * frame_bytes
    if element.length == UNDEFINED_LENGTH:
        raise _mismatch("Uncompressed PixelData has no length; export the run again.", "PixelData")
    if element.length < announced:
        raise _mismatch(
            f"PixelData has {element.length} bytes, but NumberOfFrames, Rows and Columns announce {announced}; send it again."
        )
    if element.offset + element.length > header.file_size:
        raise truncation_problem("PixelData")
    if element.length > announced + announced % 2:
        warnings.append(HeaderWarning.PIXEL_DATA_LONGER)
    return tuple(((element.offset + frame * frame_bytes, frame_bytes),) for frame in range(frames))


@dataclass(frozen=True, slots=True)
class _Fragments:
    """The pieces of encapsulated pixel data: the basic offset table, and offset and length of each fragment's value."""

    offset_table: tuple[int, ...]
    extents: tuple[Extent, ...]


def _fragments(file: BufferedReader, header: Header) -> _Fragments:
    element = header.pixel_element
    assert element is not None
    if element.length != UNDEFINED_LENGTH:
        raise _mismatch("Compressed PixelData must be encapsulated (undefined length).", "PixelData")
    table: tuple[int, ...] | None = None
    extents: list[Extent] = []
    position = element.offset
    while True:
        file.seek(position)
        start = file.read(8)
        if len(start) < 8:
            raise truncation_problem("PixelData")
        group, number, length = struct.unpack("<HHL", start)
        position += 8
        if (group, number) == _DELIMITER:
            break
        if (group, number) != _ITEM or length == UNDEFINED_LENGTH:
            raise dicom_problem(
                DicomCode.MALFORMED,
                "The compressed PixelData does not consist of items; export the run again.",
                "PixelData",
            )
        if position + length > header.file_size:
            raise truncation_problem("PixelData")
        if table is None:
            if length > 4 * _MOST_FRAGMENTS:
                raise dicom_problem(
                    DicomCode.MALFORMED, "The offset table is too long; export the run again.", "PixelData"
                )
            table = struct.unpack(f"<{length // 4}L", file.read(length // 4 * 4)) if length % 4 == 0 else ()
        elif length:
            extents.append((position, length))
            if len(extents) > _MOST_FRAGMENTS:
                raise dicom_problem(
                    DicomCode.MALFORMED, "PixelData has too many fragments; export the run again.", "PixelData"
                )
        position += length
    return _Fragments(table or (), tuple(extents))


def _group(
    file: BufferedReader, fragments: _Fragments, layout: PixelLayout, warnings: list[HeaderWarning]
) -> tuple[tuple[Extent, ...], ...]:
    """Return the fragments of each frame.

    With as many fragments as frames, each frame has one. Otherwise a frame begins at each start of a compressed image: a
    fragment never contains parts of two frames (PS3.5 A.4). The offset table only counts where the starts do not show; a table
    whose length is not NumberOfFrames is ignored.
    """
    extents, frames = fragments.extents, layout.frames
    if len(extents) < frames:
        raise _mismatch(
            f"NumberOfFrames announces {frames} frames, but PixelData has {len(extents)} fragments; send it again."
        )
    if len(extents) == frames:
        return tuple((extent,) for extent in extents)
    if frames == 1 and len(fragments.offset_table) <= 1:
        return (extents,)
    starts = _starts_by_signature(file, extents, layout)
    if len(starts) != frames:
        starts = _starts_by_table(fragments, frames) or starts
    if not starts:
        raise _mismatch("The fragments of PixelData cannot be divided into frames; export the run again.", "PixelData")
    if len(starts) < frames:
        raise _mismatch(f"NumberOfFrames announces {frames} frames, but PixelData has {len(starts)}; send it again.")
    if len(starts) > frames:
        warnings.append(HeaderWarning.PIXEL_DATA_LONGER)
    ends = [*starts[1:], len(extents)]
    return tuple(extents[start:end] for start, end in list(zip(starts, ends, strict=True))[:frames])


def _starts_by_table(fragments: _Fragments, frames: int) -> list[int]:
    """Return the number of each frame's first fragment by the offset table.

    The list is empty when the table has another length than ``frames``, or is wrong.
    """
    table, extents = fragments.offset_table, fragments.extents
    if len(table) != frames or table[0] != 0:
        return []
    # Offsets count from the first fragment's item tag, 8 bytes before its value.
    number_at = {offset - extents[0][0]: number for number, (offset, _) in enumerate(extents)}
    starts = [number_at.get(offset, -1) for offset in table]
    return starts if starts == sorted(set(starts)) and starts[0] == 0 else []


def _starts_by_signature(file: BufferedReader, extents: tuple[Extent, ...], layout: PixelLayout) -> list[int]:
    """Return the number of each fragment that begins as a compressed image does."""
    signatures = _signatures(layout)
    starts = []
    for number, (offset, _) in enumerate(extents):
        file.seek(offset)
        if file.read(len(signatures[0])).startswith(signatures):
            starts.append(number)
    return starts if starts and starts[0] == 0 else []


def _signatures(layout: PixelLayout) -> tuple[bytes, ...]:
    """Return the first bytes of a compressed image; the longest first."""
    if layout.transfer_syntax in RLE:
        # Number of segments, and the offset of the first one behind the header: PS3.5 G.5.
        return (struct.pack("<2L", layout.bits_allocated // 8, 64),)
    if layout.transfer_syntax in JPEG_2000:
        return JP2_SIGNATURE, b"\xff\x4f\xff\x51"
    return (b"\xff\xd8\xff",)
