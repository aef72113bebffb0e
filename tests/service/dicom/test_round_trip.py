"""What is written is what is read, bit for bit, and in memory that does not grow with the run."""

from __future__ import annotations

import io
import itertools
import json
import pickle
import tracemalloc
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import jpeg_ls
import numpy as np
import pydicom
import pytest
from numpy.typing import NDArray
from PIL import Image
from pydicom.pixels.encoders.base import get_encoder
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    JPEGLSLossless,
    JPEGLSNearLossless,
    RLELossless,
)

from fluoromap.contracts import FrameSource
from fluoromap.geometry import Gantry
from fluoromap_service.dicom import InstanceFacts, deterministic_uid, inflation, open_frames, read_instance, write_cine
from fluoromap_service.dicom.codestream import decode
from fluoromap_service.dicom.header import data_set_start
from fluoromap_service.dicom.pixel_layout import PixelLayout
from fluoromap_service.problem import Problem

MakeXa = Callable[..., Path]
ACQUIRED = datetime(2024, 5, 6, 7, 8, 9, 250000, tzinfo=UTC)


def cine_arguments(gantry: Gantry) -> dict[str, Any]:
    return {
        "gantry": gantry,
        "frame_time_ms": 20.0,
        "acquired": ACQUIRED,
        "study_instance_uid": "2.25.1",
        "series_number": 1,
        "sop_instance_uid": "2.25.3",
    }


def rle(frame: NDArray[Any]) -> bytes:
    bits = frame.dtype.itemsize * 8
    return get_encoder(RLELossless).encode(
        frame,
        rows=frame.shape[0],
        columns=frame.shape[1],
        samples_per_pixel=1,
        bits_allocated=bits,
        bits_stored=bits,
        pixel_representation=0,
        photometric_interpretation="MONOCHROME2",
        number_of_frames=1,
        encoding_plugin="pydicom",
    )


def test_cine(cine: Path, gantry: Gantry, pixels: NDArray[np.uint16]) -> None:
    facts = read_instance(cine)
    assert (facts.frames, facts.rows, facts.columns) == (5, 24, 32)
    assert (facts.sop_instance_uid, facts.study_instance_uid, facts.series_number) == ("2.25.2", "2.25.1", 7)
    assert facts.primary_deg == gantry.primary_deg
    assert facts.secondary_deg == gantry.secondary_deg
    assert facts.source_detector_mm == gantry.source_detector_mm
    assert facts.source_isocentre_mm == gantry.source_isocentre_mm
    assert facts.pixel_spacing_mm == gantry.pixel_spacing_mm
    assert facts.image_axes == gantry.image_axes
    assert facts.acquired == ACQUIRED
    assert facts.frame_time_ms == pytest.approx(1000 / 60)
    assert facts.r_wave_frames == (0, 3)
    assert (facts.missing, facts.warnings, facts.plane) == ((), (), "single")
    assert (facts.pixels.logarithmic, facts.pixels.bits_stored, facts.pixels.monochrome1) == (False, 12, False)

    frames: FrameSource = open_frames(cine, facts)
    assert (len(frames), frames.shape) == (5, (24, 32))
    assert frames[2].dtype == np.uint16
    np.testing.assert_array_equal(np.stack(list(frames)), pixels)
    np.testing.assert_array_equal(frames[4], pixels[4])
    with pytest.raises(IndexError):
        frames[5]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(frames))[1], pixels[1])


def test_cine_is_what_others_read_too(cine: Path, pixels: NDArray[np.uint16]) -> None:
    dataset = pydicom.dcmread(cine)
    assert str(dataset.PatientName) == "SIMULATED^PHANTOM"
    np.testing.assert_array_equal(dataset.pixel_array, pixels)


def test_facts_survive_json(cine: Path) -> None:
    facts = read_instance(cine)
    assert InstanceFacts.from_json(json.loads(json.dumps(facts.to_json()))) == facts


def test_same_arguments_same_bytes(tmp_path: Path, gantry: Gantry, pixels: NDArray[np.uint16]) -> None:
    first, second = tmp_path / "1", tmp_path / "2"
    for path in (first, second):
        write_cine(path, pixels, frame_count=5, **cine_arguments(gantry))
    assert first.read_bytes() == second.read_bytes()


def test_deterministic_uids() -> None:
    assert deterministic_uid("a", "b") == deterministic_uid("a", "b") != deterministic_uid("a", "c")
    assert pydicom.uid.UID(deterministic_uid("a")).is_valid


@pytest.mark.parametrize("count", [4, 6])
def test_wrong_number_of_frames_leaves_no_file(
    tmp_path: Path, gantry: Gantry, pixels: NDArray[np.uint16], count: int
) -> None:
    with pytest.raises(ValueError, match="announced"):
        write_cine(tmp_path / "x", pixels, frame_count=count, **cine_arguments(gantry))
    with pytest.raises(ValueError, match="12 bits"):
        write_cine(tmp_path / "x", pixels + np.uint16(4096), frame_count=5, **cine_arguments(gantry))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("offset_table", [True, False])
def test_rle(make_xa: MakeXa, dtype: type, offset_table: bool) -> None:
    rng = np.random.default_rng(3)
    frames: NDArray[Any] = rng.integers(0, 200, (4, 31, 17)).astype(dtype)
    frames[1] = 7
    frames[2, :, 5:] = 250
    path = make_xa(frames, syntax=RLELossless, fragments=[rle(frame) for frame in frames], offset_table=offset_table)
    np.testing.assert_array_equal(np.stack(list(open_frames(path, read_instance(path)))), frames)


def test_rle_equals_pydicom_on_long_runs(make_xa: MakeXa) -> None:
    frames = np.repeat(np.arange(64, dtype=np.uint16) * 900, 64).reshape(1, 64, 64)
    path = make_xa(frames, syntax=RLELossless, fragments=[rle(frames[0])])
    np.testing.assert_array_equal(open_frames(path, read_instance(path))[0], pydicom.dcmread(path).pixel_array)


def jpeg_baseline(frame: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "JPEG", quality=90)
    return buffer.getvalue() + b"\0" * (len(buffer.getvalue()) % 2)


@pytest.mark.parametrize("damage", [(b"\xff\xe0", b"\xff\x01"), (b"\xff\xdb", b"\x00\xdb"), (b"\xff\xc0", b"\xff\x02")])
def test_damaged_jpeg_header_is_refused_before_the_decoder_sees_it(
    make_xa: MakeXa, damage: tuple[bytes, bytes]
) -> None:
    """GDCM would end the whole process at the first of these."""
    frame = np.zeros((32, 48), np.uint8)
    stream = jpeg_baseline(frame).replace(*damage, 1)
    with pytest.raises(Problem, match="no valid header"):
        read_instance(make_xa(frame[None], syntax=pydicom.uid.JPEGBaseline8Bit, fragments=[stream]))


def test_odd_jfif_version_is_no_reason_to_refuse(make_xa: MakeXa) -> None:
    frame = np.full((32, 48), 90, np.uint8)
    stream = jpeg_baseline(frame).replace(b"JFIF\0\x01", b"JFIF\0\x63", 1)
    path = make_xa(frame[None], syntax=pydicom.uid.JPEGBaseline8Bit, fragments=[stream])
    assert np.abs(open_frames(path, read_instance(path))[0].astype(int) - 90).max() <= 2


def jpeg_2000(frame: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "JPEG2000", irreversible=False, no_jp2=True)
    return buffer.getvalue() + b"\0" * (len(buffer.getvalue()) % 2)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_jpeg_2000(make_xa: MakeXa, dtype: type) -> None:
    frames: NDArray[Any] = np.random.default_rng(4).integers(0, 256, (2, 40, 30)).astype(dtype)
    path = make_xa(frames, syntax=pydicom.uid.JPEG2000Lossless, fragments=[jpeg_2000(frame) for frame in frames])
    np.testing.assert_array_equal(np.stack(list(open_frames(path, read_instance(path)))), frames)


@pytest.mark.parametrize(
    ("cuts", "offset_table"), [((1, 1, 1), False), ((1, 1, 1), True), ((2, 1, 3), True), ((2, 1, 3), False)]
)
def test_frames_in_one_or_many_fragments(
    make_xa: MakeXa, raw_items: Callable[..., bytes], cuts: tuple[int, ...], offset_table: bool
) -> None:
    ramp = np.linspace(0, 255, 48).astype(np.uint8)
    frames = np.stack([np.tile(np.roll(ramp, 9 * shift), (32, 1)) for shift in range(3)])
    streams = [jpeg_baseline(frame) for frame in frames]
    pieces, offsets, position = [], [], 0
    for stream, cut in zip(streams, cuts, strict=True):
        offsets.append(position)
        step = -(-len(stream) // cut)
        step += step % 2
        for start in range(0, len(stream), step):
            pieces.append(stream[start : start + step])
            position += 8 + len(pieces[-1])
    table = np.array(offsets, dtype="<u4").tobytes() if offset_table else b""
    path = make_xa(frames, syntax=pydicom.uid.JPEGBaseline8Bit, fragments=[b"here"])
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"\xfe\xff\x00\xe0")] + raw_items(table, *pieces))
    facts = read_instance(path)
    for decoded, frame in zip(open_frames(path, facts), frames, strict=True):
        assert np.abs(decoded.astype(int) - frame).mean() < 12
        assert decoded.shape == frame.shape


def test_one_frame_in_many_fragments(make_xa: MakeXa, raw_items: Callable[..., bytes]) -> None:
    frame = np.random.default_rng(5).integers(0, 256, (20, 20)).astype(np.uint8)
    stream = jpeg_2000(frame)
    path = make_xa(frame[None], syntax=pydicom.uid.JPEG2000Lossless, fragments=[b"here"])
    content = path.read_bytes()
    pieces = [stream[start : start + 50] for start in range(0, len(stream), 50)]
    path.write_bytes(content[: content.index(b"\xfe\xff\x00\xe0")] + raw_items(b"", *pieces))
    np.testing.assert_array_equal(open_frames(path, read_instance(path))[0], frame)


def test_jpeg_ls(make_xa: MakeXa) -> None:
    """Frame of ITU-T T.87 annex H.3: the standard's own worked example, 4 x 4 pixels of 8 bits."""
    image = np.array([[0, 0, 90, 74], [68, 50, 43, 205], [64, 145, 145, 145], [100, 145, 145, 145]], dtype=np.uint8)
    stream = bytes.fromhex(
        "FFD8 FFF7 000B 08 0004 0004 01 011100 FFDA 0008 01 0100 00 00 00 C00000 6C80 208E 01C0 0000 5740 0000 6EE6 "
        "0000 01BC 1800 0005 D800 0091 60 FFD9"
    )
    layout = PixelLayout(4, 4, 1, 8, 8, JPEGLSLossless, ((),))
    np.testing.assert_array_equal(decode(layout, stream), image)


@pytest.mark.parametrize("syntax", [JPEGLSLossless, JPEGLSNearLossless])
@pytest.mark.parametrize(
    ("bits_stored", "bits_allocated"),
    [(stored, 8) for stored in range(2, 9)] + [(stored, 16) for stored in range(2, 17)],
)
def test_jpeg_ls_of_every_precision(bits_stored: int, bits_allocated: int, syntax: str) -> None:
    """Some encoders state the bits of the pixels, others those of the cells."""
    cell = np.uint8 if bits_stored <= 8 else np.uint16
    image = np.random.default_rng(bits_stored).integers(0, 1 << bits_stored, (20, 24)).astype(cell)
    for precision in (bits_stored, 8 * image.itemsize):
        stream = jpeg_ls.encode_pixel_data(
            image.tobytes(), rows=20, columns=24, samples_per_pixel=1, bits_allocated=8 * image.itemsize,
            bits_stored=precision, photometric_interpretation="MONOCHROME2", planar_configuration=0,
        )  # fmt: skip
        layout = PixelLayout(20, 24, 1, bits_allocated, bits_stored, syntax, ((),))
        decoded = decode(layout, bytes(stream))
        assert decoded.dtype == f"<u{bits_allocated // 8}"
        assert decoded.flags.writeable
        np.testing.assert_array_equal(decoded, image)


def test_implicit_and_padded(make_xa: MakeXa) -> None:
    frames = np.arange(15, dtype=np.uint8).reshape(1, 3, 5)
    for syntax in (pydicom.uid.ImplicitVRLittleEndian, pydicom.uid.ExplicitVRLittleEndian):
        path = make_xa(frames, syntax=syntax)
        facts = read_instance(path)
        assert facts.warnings == ()
        np.testing.assert_array_equal(open_frames(path, facts)[0], frames[0])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("syntax", [DeflatedExplicitVRLittleEndian, ExplicitVRBigEndian])
def test_syntaxes_of_old_archives(make_xa: MakeXa, syntax: str, dtype: type) -> None:
    """Frames of an odd number of pixels: a word of two pixels may belong to two frames."""
    frames = np.random.default_rng(4).integers(0, 250, (3, 5, 7)).astype(dtype)
    frames[:, 0, 0] = np.iinfo(dtype).max
    path = make_xa(frames, syntax=syntax, PositionerPrimaryAngle="-32.5", RWavePointer=[1, 3])
    facts = read_instance(path)
    assert (facts.transfer_syntax, facts.primary_deg, facts.r_wave_frames) == (syntax, -32.5, (0, 2))
    opened = open_frames(path, facts)
    np.testing.assert_array_equal(np.stack(list(opened)), frames)
    np.testing.assert_array_equal(opened[1], frames[1])
    np.testing.assert_array_equal(pydicom.dcmread(path).pixel_array, frames)


def test_a_deflated_run_that_ends_in_black(make_xa: MakeXa, monkeypatch: pytest.MonkeyPatch) -> None:
    """One code can stand for 258 equal pixels: the inflater has them when its input has ended."""
    random = np.random.default_rng(4)
    # The end of the last code falls on another bit in each file.
    for _ in range(32):
        frames = np.zeros((2, 24, 32), np.uint8)
        frames[:, 3:9, 3:9] = random.integers(0, 255, (6, 6))
        path = make_xa(frames, syntax=DeflatedExplicitVRLittleEndian)
        with inflation.open_dicom(path) as file:
            inflated_bytes = len(file.read()) - data_set_start(file)[1]
        with monkeypatch.context() as patched:
            patched.setattr(inflation, "_CHUNK_BYTES", inflated_bytes - 130)
            np.testing.assert_array_equal(np.stack(list(open_frames(path, read_instance(path)))), frames)


def test_more_pixel_data_than_announced(make_xa: MakeXa) -> None:
    frames = np.arange(3 * 4 * 4, dtype=np.uint8).reshape(3, 4, 4)
    path = make_xa(frames, NumberOfFrames=2)
    facts = read_instance(path)
    assert facts.warnings == ("pixel_data_longer",)
    np.testing.assert_array_equal(np.stack(list(open_frames(path, facts))), frames[:2])


def test_file_that_changed(cine: Path, make_xa: MakeXa) -> None:
    other = make_xa(np.zeros((1, 4, 4), np.uint8))
    with pytest.raises(Problem):
        open_frames(other, read_instance(cine))


def peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_the_run(tmp_path: Path) -> None:
    gantry = Gantry(0, 0, 1000, 750, (0.8, 0.8), rows=256, columns=256)
    frame = np.full((256, 256), 100, np.uint16)

    def write(path: Path, count: int) -> None:
        write_cine(path, itertools.repeat(frame, count), frame_count=count, **cine_arguments(gantry))

    def read(path: Path) -> None:
        for _ in open_frames(path, read_instance(path)):
            pass

    peaks = {}
    for count in (100, 1000):
        path = tmp_path / f"{count}.dcm"
        peaks[count] = (peak_bytes(partial(write, path, count)), peak_bytes(partial(read, path)))
    # The index of the frames is all that may grow: about 200 bytes a frame.
    assert peaks[1000][0] < peaks[100][0] + 100_000
    assert peaks[1000][1] < peaks[100][1] + 900 * 400
    assert peaks[1000][1] < 8 * frame.nbytes
