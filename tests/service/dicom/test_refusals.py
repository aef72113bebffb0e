"""Every file that cannot be used is refused at the door, with its code, its status and no patient data."""

from __future__ import annotations

import contextlib
import gzip
import pickle
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydicom.fileset import FileSet
from pydicom.uid import (
    MPEG2MPML,
    CTImageStorage,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGExtended12Bit,
    JPEGLosslessSV1,
    RLELossless,
    XRay3DAngiographicImageStorage,
)

from fluoromap_service.dicom import DicomCode, dicom_problem, inflation, read_instance
from fluoromap_service.problem import Problem

MakeXa = Callable[..., Path]
FRAMES = np.arange(3 * 8 * 10, dtype=np.uint16).reshape(3, 8, 10)


def _where(problem: Problem) -> str:
    """Return the one place that a problem names."""
    ((where, _),) = problem.errors
    return where


def refusal(path: Path) -> Problem:
    with pytest.raises(Problem) as caught:
        read_instance(path)
    problem = caught.value
    assert "SECRET" not in str(problem)
    assert str(path) not in str(problem)
    assert path.name not in str(problem)
    assert str(problem).endswith(".")
    return problem


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "empty"),
        (b"%PDF-1.7 and so on" * 20, "a PDF document"),
        (gzip.compress(b"DICM" * 100), "a gzip file, not a DICOM file; unpack it"),
        (b"PK\x03\x04" + bytes(200), "a ZIP archive, not a DICOM file; unpack it"),
        (b"\xff\xd8\xff\xe0" + bytes(200), "a JPEG picture"),
        (bytes(4096), "send DICOM files only"),
        (b"\x1f", "send DICOM files only"),
    ],
)
def test_what_is_not_dicom(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "x.bin"
    path.write_bytes(content)
    problem = refusal(path)
    assert (problem.code, problem.status) == (DicomCode.NOT_DICOM, 415)
    assert told in problem.detail


def test_a_run_whose_preamble_looks_like_another_format(tmp_path: Path, cine: Path) -> None:
    """The preamble of a slide may make it a TIFF file too (PS3.10 section 7.1)."""
    path = tmp_path / "dual.dcm"
    path.write_bytes(b"PK\x03\x04" + cine.read_bytes()[4:])
    assert read_instance(path) == read_instance(cine)


def test_bare_data_set(tmp_path: Path, cine: Path) -> None:
    content = cine.read_bytes()
    path = tmp_path / "bare.dcm"
    path.write_bytes(content[content.index(b"\x08\x00\x05\x00CS") :])
    problem = refusal(path)
    assert (problem.code, problem.status) == (DicomCode.NO_PART10_HEADER, 415)


@pytest.mark.parametrize("kind", [CTImageStorage, XRay3DAngiographicImageStorage])
def test_other_kinds(make_xa: MakeXa, kind: str) -> None:
    problem = refusal(make_xa(FRAMES, SOPClassUID=kind))
    assert (problem.code, problem.status, _where(problem)) == (DicomCode.NOT_XA, 422, "SOPClassUID")


def test_the_class_of_another_kind_is_named(make_xa: MakeXa) -> None:
    assert "CT Image Storage" in str(refusal(make_xa(FRAMES, SOPClassUID=CTImageStorage)))
    assert "SECRET" not in str(refusal(make_xa(FRAMES, SOPClassUID="SECRET^PATIENT")))


def test_the_table_of_contents_of_a_disc(tmp_path: Path, cine: Path) -> None:
    disc = FileSet()
    disc.add(with_patient(cine))
    disc.write(tmp_path / "disc")
    problem = refusal((tmp_path / "disc" / "DICOMDIR").rename(tmp_path / "first.dcm"))
    assert (problem.code, problem.status) == (DicomCode.NOT_XA, 422)
    assert "DICOMDIR" in str(problem)
    assert "image files" in str(problem)


def with_patient(path: Path) -> pydicom.Dataset:
    """Return the data set of a file with the attributes that a DICOMDIR needs."""
    dataset = pydicom.dcmread(path)
    dataset.PatientID, dataset.PatientName, dataset.StudyID, dataset.StudyDate = "P", "SECRET", "1", "20240506"
    dataset.StudyTime, dataset.InstanceNumber, dataset.SeriesNumber = "070809", 1, 1
    dataset.AccessionNumber = ""
    return dataset


def element(representation: bytes, length_bytes: int) -> bytes:
    """Return an element of explicit representation with four bytes."""
    length = struct.pack("<H", 4) if length_bytes == 2 else struct.pack("<HL", 0, 4)
    return struct.pack("<HH", 0x0027, 0x1001) + representation + length + b"abcd"


@pytest.mark.parametrize("representation", [b"ZZ", b"OX", b"??", b"  ", b"\0\0", b"us"])
@pytest.mark.parametrize("length_bytes", [2, 4])
def test_an_unknown_value_representation_is_named(cine: Path, representation: bytes, length_bytes: int) -> None:
    content = cine.read_bytes()
    at = content.index(b"\x28\x00\x02\x00US")
    cine.write_bytes(content[:at] + element(representation, length_bytes) + content[at:])
    problem = refusal(cine)
    assert (problem.code, _where(problem)) == (DicomCode.MALFORMED, "(0027,1001)")
    assert "value representation" in str(problem)


def test_an_element_of_implicit_representation_among_explicit_ones(cine: Path) -> None:
    content = cine.read_bytes()
    at = content.index(b"\x28\x00\x02\x00US")
    cine.write_bytes(content[:at] + struct.pack("<HHL", 0x0027, 0x1001, 4) + b"abcd" + content[at:])
    assert read_instance(cine).frames == 5


def test_secondary_capture_of_another_modality(make_xa: MakeXa) -> None:
    capture = "1.2.840.10008.5.1.4.1.1.7"
    assert refusal(make_xa(FRAMES, SOPClassUID=capture, Modality="US")).code is DicomCode.NOT_XA
    assert read_instance(make_xa(FRAMES, SOPClassUID=capture)).frames == 3


def test_no_pixel_data_even_with_an_icon(make_xa: MakeXa) -> None:
    icon = pydicom.Dataset()
    icon.Rows = icon.Columns = 8
    icon.add_new(0x7FE00010, "OW", b"\0" * 128)
    path = make_xa(FRAMES, PixelData=None, IconImageSequence=[icon])
    problem = refusal(path)
    assert (problem.code, problem.status, _where(problem)) == (DicomCode.NO_PIXEL_DATA, 422, "PixelData")


def test_empty_pixel_data(make_xa: MakeXa) -> None:
    assert refusal(make_xa(FRAMES, PixelData=b"")).code is DicomCode.NO_PIXEL_DATA


def test_truncated_anywhere(cine: Path) -> None:
    content = cine.read_bytes()
    pixels_at = content.index(b"\xe0\x7f\x10\x00OW")
    for length in (len(content) - 1, len(content) - 3000, pixels_at + 12, pixels_at + 5, pixels_at - 1, 400, 200, 140):
        cine.write_bytes(content[:length])
        problem = refusal(cine)
        assert problem.status == 400, length
        assert problem.code in (DicomCode.TRUNCATED, DicomCode.MALFORMED)
    cine.write_bytes(content[:-1])
    assert refusal(cine).code is DicomCode.TRUNCATED


def test_truncated_encapsulated(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, syntax=RLELossless, fragments=[b"abcd" * 50] * 3)
    content = path.read_bytes()
    for missing in (1, 8, 9, 150, 300):
        path.write_bytes(content[:-missing])
        assert refusal(path).code is DicomCode.TRUNCATED


def test_few_bytes_that_claim_gigabytes(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, NumberOfFrames=20000, Rows=8000, Columns=8000)
    tracemalloc.start()
    try:
        problem = refusal(path)
        assert tracemalloc.get_traced_memory()[1] < 4_000_000
    finally:
        tracemalloc.stop()
    assert (problem.code, problem.status, _where(problem)) == (DicomCode.PIXEL_DATA_MISMATCH, 400, "NumberOfFrames")


def test_native_length_that_claims_gigabytes(cine: Path) -> None:
    content = bytearray(cine.read_bytes())
    at = content.index(b"\xe0\x7f\x10\x00OW")
    content[at + 8 : at + 12] = struct.pack("<L", 0xFFFFFFF0)
    cine.write_bytes(content)
    assert refusal(cine).code is DicomCode.TRUNCATED


def test_number_of_frames_that_fragments_cannot_hold(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, syntax=JPEGLosslessSV1, fragments=[b"\xff\xd8\xff\xd9"] * 3, NumberOfFrames=4)
    problem = refusal(path)
    assert (problem.code, _where(problem)) == (DicomCode.PIXEL_DATA_MISMATCH, "NumberOfFrames")


@pytest.mark.parametrize(
    ("changes", "code", "status"),
    [
        ({"Rows": 9000}, DicomCode.FRAME_TOO_LARGE, 413),
        ({"NumberOfFrames": 20001}, DicomCode.TOO_MANY_FRAMES, 413),
        ({"NumberOfFrames": 0}, DicomCode.MALFORMED, 400),
        ({"NumberOfFrames": -5}, DicomCode.MALFORMED, 400),
        ({"Rows": 0}, DicomCode.MALFORMED, 400),
        ({"Columns": None}, DicomCode.MALFORMED, 400),
        ({"SOPInstanceUID": "../../etc"}, DicomCode.MALFORMED, 400),
        ({"StudyInstanceUID": None}, DicomCode.MALFORMED, 400),
        ({"SamplesPerPixel": 3, "PhotometricInterpretation": "RGB"}, DicomCode.UNSUPPORTED_PIXELS, 422),
        ({"PixelRepresentation": 1}, DicomCode.UNSUPPORTED_PIXELS, 422),
        ({"BitsAllocated": 32}, DicomCode.UNSUPPORTED_PIXELS, 422),
        ({"BitsStored": 12, "HighBit": 15}, DicomCode.UNSUPPORTED_PIXELS, 422),
    ],
)
def test_impossible_images(make_xa: MakeXa, changes: dict[str, Any], code: DicomCode, status: int) -> None:
    problem = refusal(make_xa(FRAMES, **changes))
    assert (problem.code, problem.status) == (code, status)


def with_syntax(path: Path, old: str, new: str) -> Path:
    """Write the file with another TransferSyntaxUID in its meta information."""

    def element(uid: str) -> bytes:
        value = uid.encode() + b"\0" * (len(uid) % 2)
        return b"\x02\x00\x10\x00UI" + struct.pack("<H", len(value)) + value

    content = path.read_bytes()
    assert element(old) in content
    path.write_bytes(content.replace(element(old), element(new), 1))
    return path


@pytest.mark.parametrize("syntax", [MPEG2MPML, "1.2.3.4.5"])
def test_transfer_syntaxes_nobody_decodes(make_xa: MakeXa, syntax: str) -> None:
    path = make_xa(FRAMES, syntax=JPEGLosslessSV1, fragments=[b"movie!"])
    problem = refusal(with_syntax(path, JPEGLosslessSV1, syntax))
    assert (problem.code, problem.status, _where(problem)) == (DicomCode.UNDECODABLE, 422, "TransferSyntaxUID")
    assert pydicom.uid.UID(syntax).name in str(problem)


@pytest.mark.parametrize("syntax", pydicom.uid.MPEGTransferSyntaxes)
def test_a_video_is_called_one(make_xa: MakeXa, syntax: str) -> None:
    path = make_xa(
        FRAMES, syntax=JPEGLosslessSV1, fragments=[b"movie!"], SamplesPerPixel=3, PhotometricInterpretation="YBR_PARTIAL_420"
    )  # fmt: skip
    problem = refusal(with_syntax(path, JPEGLosslessSV1, syntax))
    assert (problem.code, _where(problem)) == (DicomCode.UNDECODABLE, "TransferSyntaxUID")
    assert "video" in str(problem)
    assert "send the frames" in str(problem)


def test_deflated_data_that_is_none(make_xa: MakeXa) -> None:
    problem = refusal(with_syntax(make_xa(FRAMES), ExplicitVRLittleEndian, DeflatedExplicitVRLittleEndian))
    assert (problem.code, problem.status) == (DicomCode.MALFORMED, 400)


def test_deflated_data_that_ends_too_early(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, syntax=DeflatedExplicitVRLittleEndian)
    path.write_bytes(path.read_bytes()[:-40])
    assert refusal(path).code is DicomCode.TRUNCATED


def test_deflated_data_without_end_fills_no_disk(make_xa: MakeXa, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inflation, "SMALL_BYTES", 2**16)
    path = make_xa(np.zeros((40, 64, 1024), np.uint8), syntax=DeflatedExplicitVRLittleEndian)
    assert refusal(path).code is DicomCode.HEADER_TOO_LARGE


def test_little_endian_data_announced_as_big_endian(make_xa: MakeXa) -> None:
    problem = refusal(with_syntax(make_xa(FRAMES), ExplicitVRLittleEndian, ExplicitVRBigEndian))
    assert problem.status == 400


def test_twelve_bit_jpeg_extended(make_xa: MakeXa) -> None:
    frame_header = struct.pack(">HHBHHB3s", 0xFFC1, 11, 12, 8, 10, 1, b"\x01\x11\x00") + b"\xff\xda\x00\x02"
    path = make_xa(FRAMES[:1], syntax=JPEGExtended12Bit, fragments=[b"\xff\xd8" + frame_header + b"\xff\xd9"])
    problem = refusal(path)
    assert (problem.code, problem.status) == (DicomCode.UNDECODABLE, 422)
    assert "JPEG Extended" in str(problem)


def test_codestream_that_claims_another_size(make_xa: MakeXa) -> None:
    frame_header = struct.pack(">HHBHHB3s", 0xFFC3, 11, 12, 65000, 65000, 1, b"\x01\x11\x00") + b"\xff\xda\x00\x02"
    path = make_xa(FRAMES[:1], syntax=JPEGLosslessSV1, fragments=[b"\xff\xd8" + frame_header + b"\xff\xd9"])
    assert refusal(path).code is DicomCode.PIXEL_DATA_MISMATCH
    size = struct.pack(">HHHH8LHBBB", 0xFF4F, 0xFF51, 41, 0, 60000, 60000, 0, 0, 1, 1, 0, 0, 1, 11, 1, 1)
    path = make_xa(FRAMES[:1], syntax=JPEG2000Lossless, fragments=[size])
    assert refusal(path).code is DicomCode.UNDECODABLE


@pytest.mark.parametrize("syntax", [JPEGLosslessSV1, JPEG2000Lossless, RLELossless])
def test_fragments_of_rubbish(make_xa: MakeXa, syntax: str) -> None:
    assert refusal(make_xa(FRAMES[:1], syntax=syntax, fragments=[b"\x55" * 300])).code is DicomCode.UNDECODABLE


def test_rle_that_expands_beyond_the_frame_stays_small(make_xa: MakeXa) -> None:
    segment = b"\x81\x00" * 30_000
    header = struct.pack("<16L", 1, 64, *[0] * 14)
    path = make_xa(np.zeros((1, 100, 100), np.uint8), syntax=RLELossless, fragments=[header + segment])
    tracemalloc.start()
    try:
        assert read_instance(path).frames == 1
        assert tracemalloc.get_traced_memory()[1] < 3_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("defined_length", [True, False])
def test_header_made_of_millions_of_empty_items(
    make_xa: MakeXa, defined_length: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The real budget takes seconds to use up.
    monkeypatch.setattr("fluoromap_service.dicom.header.HEADER_READS", 30_000)
    path = make_xa(FRAMES)
    content = path.read_bytes()
    at = content.index(b"\xe0\x7f\x10\x00OW")
    items = struct.pack("<HHL", 0xFFFE, 0xE000, 0) * 1_500_000
    length = len(items) if defined_length else 0xFFFFFFFF
    end = b"" if defined_length else struct.pack("<HHL", 0xFFFE, 0xE0DD, 0)
    # The groups' tag number comes before PixelData's.
    sequence = struct.pack("<HH2sHL", 0x5200, 0x9229, b"SQ", 0, length) + items + end
    path.write_bytes(content[:at] + sequence + content[at:])
    assert refusal(path).code is DicomCode.HEADER_TOO_LARGE


def test_fragments_that_are_no_items(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES[:1], syntax=RLELossless, fragments=[b"\0" * 64])
    content = path.read_bytes()
    first = content.index(b"\xfe\xff\x00\xe0")
    path.write_bytes(content[:first] + b"\x10\x00\x10\x00" + content[first + 4 :])
    assert refusal(path).code is DicomCode.MALFORMED


def test_problem_survives_a_process_boundary() -> None:
    problem = dicom_problem(DicomCode.TRUNCATED, "Sentence.", "PixelData")
    copy = pickle.loads(pickle.dumps(problem))
    assert (copy.code, copy.detail, _where(copy), copy.status) == (DicomCode.TRUNCATED, "Sentence.", "PixelData", 400)


def test_every_code_has_a_status() -> None:
    assert {code.status for code in DicomCode} == {400, 413, 415, 422}


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_headers_are_read_or_refused(cine: Path, data: st.DataObject) -> None:
    whole = cine.with_suffix(".whole")
    if not whole.exists():
        whole.write_bytes(cine.read_bytes())
    content = bytearray(whole.read_bytes())
    header_end = content.index(b"\xe0\x7f\x10\x00OW") + 12
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(128, header_end - 1))] = data.draw(st.integers(0, 255))
    cine.write_bytes(content)
    # Anything but a Problem is a bug, and fails here.
    with contextlib.suppress(Problem):
        read_instance(cine).to_json()
