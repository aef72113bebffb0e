"""Encapsulated pixel data as other systems write it (PS3.5 A.4): offset tables, fragments and containers beside the norm."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from pydicom.pixels.encoders.base import get_encoder
from pydicom.uid import JPEG2000Lossless, JPEGBaseline8Bit, RLELossless

from fluoromap_service.dicom import DicomCode, open_frames, read_instance
from fluoromap_service.problem import Problem

MakeXa = Callable[..., Path]
Items = Callable[..., bytes]
SHAPE = (24, 32)
RAMPS = np.stack([np.tile(np.roll(np.linspace(0, 255, 32).astype(np.uint8), 9 * shift), (24, 1)) for shift in range(3)])
"""Three frames that differ by a roll."""


def jpeg(frame: NDArray[np.uint8]) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(frame).save(stream, "JPEG", quality=95)
    return stream.getvalue()


def jpeg_2000(frame: NDArray[Any], boxes: bool = False) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(frame).save(stream, "JPEG2000", irreversible=False, no_jp2=not boxes)
    return stream.getvalue()


def rle(frame: NDArray[Any]) -> bytes:
    bits = frame.dtype.itemsize * 8
    return get_encoder(RLELossless).encode(
        frame, rows=SHAPE[0], columns=SHAPE[1], samples_per_pixel=1, bits_allocated=bits, bits_stored=bits,
        pixel_representation=0, photometric_interpretation="MONOCHROME2", number_of_frames=1, encoding_plugin="pydicom",
    )  # fmt: skip


CODECS: dict[str, Callable[[NDArray[Any]], bytes]] = {
    JPEGBaseline8Bit: jpeg,
    JPEG2000Lossless: jpeg_2000,
    RLELossless: rle,
}


def even(value: bytes) -> bytes:
    return value + b"\0" * (len(value) % 2)


def cut(stream: bytes, pieces: int) -> list[bytes]:
    """Return a stream in even pieces."""
    step = -(-len(stream) // pieces)
    step += step % 2
    return [even(stream[start : start + step]) for start in range(0, len(stream), step)]


def offsets(frames: list[list[bytes]]) -> list[int]:
    """Return the right offset table of frames in fragments."""
    lengths = [sum(8 + len(piece) for piece in pieces) for pieces in frames]
    return [sum(lengths[:number]) for number in range(len(frames))]


@pytest.fixture
def encapsulated(make_xa: MakeXa, raw_items: Items) -> Callable[..., Path]:
    """Writes a run of these fragments behind this offset table, both as they are."""

    def write(syntax: str, table: bytes, *fragments: bytes, **attributes: Any) -> Path:
        path = make_xa(RAMPS, syntax=syntax, fragments=[b"here"], **attributes)
        content = path.read_bytes()
        path.write_bytes(content[: content.index(b"\xfe\xff\x00\xe0")] + raw_items(table, *fragments))
        return path

    return write


def assert_ramps(path: Path, expected: NDArray[np.uint8] = RAMPS) -> None:
    facts = read_instance(path)
    assert facts.frames == len(expected)
    frames = open_frames(path, facts)
    for index in (2, 0, 1):
        assert np.abs(frames[index].astype(int) - expected[index]).mean() < 6, index


def table(numbers: list[int]) -> bytes:
    return np.array(numbers, "<u4").tobytes()


@pytest.mark.parametrize("syntax", CODECS)
@pytest.mark.parametrize("pieces", [1, 2, 3])
@pytest.mark.parametrize("kind", ["right", "none", "one zero", "one a fragment", "nonsense", "too short", "odd length"])
def test_an_offset_table_that_does_not_fit_is_ignored(
    encapsulated: Callable[..., Path], syntax: str, pieces: int, kind: str
) -> None:
    frames = [cut(CODECS[syntax](frame), pieces) for frame in RAMPS]
    fragments = [piece for pieces_of_frame in frames for piece in pieces_of_frame]
    tables = {
        "right": table(offsets(frames)),
        "none": b"",
        "one zero": table([0]),
        "one a fragment": table(offsets([[piece] for piece in fragments])),
        "nonsense": table([0, 4, 2**32 - 1]),
        "too short": table(offsets(frames)[:2]),
        "odd length": table(offsets(frames))[:-1],
    }
    assert_ramps(encapsulated(syntax, tables[kind], *fragments))


@pytest.mark.parametrize("offset_table", [b"", table([0]), table([0, 300, 500]), table([7] * 40)])
@pytest.mark.parametrize("syntax", CODECS)
def test_a_single_frame_is_all_fragments(encapsulated: Callable[..., Path], syntax: str, offset_table: bytes) -> None:
    path = encapsulated(syntax, offset_table, *cut(CODECS[syntax](RAMPS[1]), 9), NumberOfFrames=1)
    facts = read_instance(path)
    assert np.abs(open_frames(path, facts)[0].astype(int) - RAMPS[1]).mean() < 6


def test_a_table_divides_what_no_start_shows(encapsulated: Callable[..., Path]) -> None:
    """A first segment that lies behind a gap is no usual start of an RLE image."""

    def late(frame: NDArray[np.uint8]) -> bytes:
        stream = rle(frame)
        return stream[:4] + struct.pack("<L", 66) + stream[8:64] + b"\0\0" + stream[64:]

    frames = [cut(late(frame), 2) for frame in RAMPS]
    fragments = [piece for pieces in frames for piece in pieces]
    assert_ramps(encapsulated(RLELossless, table(offsets(frames)), *fragments))
    with pytest.raises(Problem) as caught:
        read_instance(encapsulated(RLELossless, b"", *fragments))
    assert caught.value.code is DicomCode.PIXEL_DATA_MISMATCH


def test_empty_fragments_odd_fragments_and_padding(encapsulated: Callable[..., Path]) -> None:
    streams = [jpeg(frame) for frame in RAMPS]
    padded = [stream + b"\xff" * (1 + len(stream) % 2) for stream in streams]
    assert_ramps(encapsulated(JPEGBaseline8Bit, b"", *padded))
    odd = [stream if len(stream) % 2 else stream + b"\0" for stream in streams]
    assert_ramps(encapsulated(JPEGBaseline8Bit, b"", *odd))
    zeros = [stream + bytes(2 + len(stream) % 2) for stream in streams]
    assert_ramps(encapsulated(JPEGBaseline8Bit, table([0]), b"", zeros[0], b"", zeros[1], zeros[2], b""))


@pytest.mark.parametrize(("lengths", "starts"), [(b"", b"\0" * 24), (b"\xff" * 24, b"\xff" * 24), (b"", b"\1" * 16)])
def test_an_extended_offset_table_is_not_needed(
    encapsulated: Callable[..., Path], lengths: bytes, starts: bytes
) -> None:
    frames = [cut(jpeg(frame), 2) for frame in RAMPS]
    path = encapsulated(
        JPEGBaseline8Bit, b"", *(piece for pieces in frames for piece in pieces),
        ExtendedOffsetTable=starts, ExtendedOffsetTableLengths=lengths,
    )  # fmt: skip
    assert_ramps(path)


@pytest.mark.parametrize("pieces", [1, 3])
@pytest.mark.parametrize("length", ["as written", "long", "to the end"])
def test_boxes_around_a_codestream_of_jpeg_2000(encapsulated: Callable[..., Path], pieces: int, length: str) -> None:
    """ITU-T T.800 I.4: the length of a box is in 4 bytes, in 8 behind the value 1, or the value 0 says to the end."""
    streams = []
    for frame in RAMPS:
        whole = jpeg_2000(frame, boxes=True)
        at = whole.index(b"jp2c") - 4
        codestream = whole[at + 8 :]
        heads = {
            "as written": whole[at : at + 8],
            "long": struct.pack(">L4sQ", 1, b"jp2c", 16 + len(codestream)),
            "to the end": struct.pack(">L4s", 0, b"jp2c"),
        }
        streams.append(whole[:at] + heads[length] + codestream)
    path = encapsulated(JPEG2000Lossless, b"", *(piece for stream in streams for piece in cut(stream, pieces)))
    np.testing.assert_array_equal(np.stack(list(open_frames(path, read_instance(path)))), RAMPS)


@pytest.mark.parametrize("damage", [slice(12, 14), slice(None, 20), slice(None, 40), slice(None, -60)])
def test_damaged_boxes_are_refused(encapsulated: Callable[..., Path], damage: slice) -> None:
    stream = jpeg_2000(RAMPS[0], boxes=True)
    broken = stream[damage] if damage.start is None else stream[:12] + b"\0\0" + stream[14:]
    path = encapsulated(JPEG2000Lossless, b"", even(broken.replace(b"jp2c", b"jp2x")), NumberOfFrames=1)
    with pytest.raises(Problem) as caught:
        read_instance(path)
    assert caught.value.code in (DicomCode.UNDECODABLE, DicomCode.PIXEL_DATA_MISMATCH)


def test_pixels_have_the_type_that_bits_allocated_states(make_xa: MakeXa) -> None:
    path = make_xa(
        RAMPS, syntax=JPEGBaseline8Bit, fragments=[even(jpeg(frame)) for frame in RAMPS], BitsAllocated=16
    )  # fmt: skip
    assert_ramps(path)
    assert open_frames(path, read_instance(path))[0].dtype == np.dtype("<u2")


def test_more_bits_than_allocated_are_refused(make_xa: MakeXa) -> None:
    frames = RAMPS.astype(np.uint16) * 200
    streams = [even(jpeg_2000(frame)) for frame in frames]
    path = make_xa(RAMPS, syntax=JPEG2000Lossless, fragments=streams)
    with pytest.raises(Problem, match="16 bits a pixel, but BitsAllocated is 8") as caught:
        read_instance(path)
    assert caught.value.code is DicomCode.PIXEL_DATA_MISMATCH


def test_rle_with_too_few_segments_is_refused(encapsulated: Callable[..., Path]) -> None:
    path = encapsulated(
        RLELossless, b"", *(rle(frame) for frame in RAMPS), BitsAllocated=16, BitsStored=12, HighBit=11
    )  # fmt: skip
    with pytest.raises(Problem, match="RLE header does not fit BitsAllocated"):
        read_instance(path)


def test_fewer_images_than_frames_are_counted(encapsulated: Callable[..., Path]) -> None:
    fragments = [piece for frame in RAMPS for piece in cut(jpeg(frame), 2)]
    with pytest.raises(Problem, match="announces 5 frames, but PixelData has 3"):
        read_instance(encapsulated(JPEGBaseline8Bit, table([0]), *fragments, NumberOfFrames=5))


def test_fill_bytes_before_a_marker(make_xa: MakeXa) -> None:
    """ITU-T T.81 B.1.1.2: any number of bytes FF may come before a marker."""
    stream = jpeg(RAMPS[0])
    path = make_xa(RAMPS[:1], syntax=JPEGBaseline8Bit, fragments=[even(stream[:2] + b"\xff\xff" + stream[2:])])
    assert np.abs(open_frames(path, read_instance(path))[0].astype(int) - RAMPS[0]).mean() < 6
