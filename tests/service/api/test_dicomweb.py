"""DICOMweb: runs in by STOW-RS, found by QIDO-RS, out by WADO-RS."""

from __future__ import annotations

import io
from email.parser import BytesParser
from email.policy import HTTP
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from fastapi.testclient import TestClient
from numpy.typing import NDArray
from PIL import Image
from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate
from pydicom.pixels.encoders.base import get_encoder
from pydicom.uid import (
    UID,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGBaseline8Bit,
    RLELossless,
)
from small_runs import COLUMNS, FRAMES, ROWS, STUDY_UID, edited, run_uid, small_run
from sqlalchemy import func, select

from fluoromap_service.settings import settings
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Instance

STUDIES = "/dicom-web/studies"
RELATED = 'multipart/related; type="application/dicom"; boundary=edge'


def body(
    *files: bytes, content_type: str = "Content-Type: application/dicom\r\n", end: bytes = b"--edge--\r\n"
) -> bytes:
    parts = [f"--edge\r\n{content_type}\r\n".encode() + file + b"\r\n" for file in files]
    return b"".join(parts) + end


def store(service: TestClient, *files: bytes, path: str = STUDIES) -> Any:
    return service.post(path, content=body(*files), headers={"content-type": RELATED})


def parts_of(answer: Any) -> list[bytes]:
    assert answer.status_code == 200, answer.text
    head = b"Content-Type: " + answer.headers["content-type"].encode() + b"\r\n\r\n"
    message = BytesParser(policy=HTTP).parsebytes(head + answer.content)
    return [part.get_payload(decode=True) for part in message.iter_parts()]  # type: ignore[misc]


def found(service: TestClient, path: str) -> list[Dataset]:
    answer = service.get(path)
    if answer.status_code == 204:
        assert answer.content == b""
        return []
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/dicom+json"
    assert answer.json() != []
    return [Dataset.from_json(entry) for entry in answer.json()]


def stored_count() -> int:
    with reading() as session:
        return session.scalar(select(func.count()).select_from(Instance)) or 0


def left_files() -> list[Path]:
    return [path for path in settings().files_dir.rglob("*") if path.is_file()]


@pytest.fixture
def two_runs(service: TestClient, tmp_path: Path) -> list[bytes]:
    """Two stored runs of one patient."""
    files = [
        edited(small_run(tmp_path, number, 90.0 * number), PatientName="Doe^Jane", PatientID="P7", StudyDate="20260301")
        for number in (1, 2)
    ]
    assert store(service, *files).status_code == 200
    return files


def address(file: bytes) -> str:
    run = pydicom.dcmread(io.BytesIO(file))
    return f"{STUDIES}/{run.StudyInstanceUID}/series/{run.SeriesInstanceUID}/instances/{run.SOPInstanceUID}"


def test_runs_join_one_mapping_study(service: TestClient, two_runs: list[bytes]) -> None:
    (study,) = service.get("/v1/studies").json()["items"]
    runs = service.get(f"/v1/studies/{study['id']}/instances").json()["items"]
    assert [run["sop_instance_uid"] for run in runs] == [run_uid(1), run_uid(2)]


def test_answer_refers_to_what_was_stored(service: TestClient, tmp_path: Path) -> None:
    file = small_run(tmp_path, 1, 0.0)
    answer = store(service, file, path=f"{STUDIES}/{STUDY_UID}")
    assert answer.status_code == 200
    result = Dataset.from_json(answer.json())
    (reference,) = result.ReferencedSOPSequence
    assert reference.ReferencedSOPInstanceUID == run_uid(1)
    assert reference.RetrieveURL == f"http://127.0.0.1{address(file)}"
    assert "FailedSOPSequence" not in result


def test_failures_have_reasons(service: TestClient, tmp_path: Path) -> None:
    good = small_run(tmp_path, 1, 0.0)
    other_pixels = edited(good, PixelData=bytes(2 * FRAMES * ROWS * COLUMNS))
    assert store(service, good).status_code == 200
    computed_tomography = edited(good, Modality="CT", SOPClassUID="1.2.840.10008.5.1.4.1.1.2")
    partly = store(service, small_run(tmp_path, 2, 0.0), other_pixels, b"no DICOM", computed_tomography)
    assert partly.status_code == 202
    result = Dataset.from_json(partly.json())
    assert [item.FailureReason for item in result.FailedSOPSequence] == [0xC001, 0xC000, 0xA900]
    assert [item.ReferencedSOPInstanceUID for item in result.ReferencedSOPSequence] == [run_uid(2)]
    assert store(service, other_pixels).status_code == 409
    assert store(service, small_run(tmp_path, 3, 0.0), path=f"{STUDIES}/1.2.3").status_code == 409
    assert stored_count() == len(left_files()) == 2


@pytest.mark.parametrize(
    ("content_type", "content", "status"),
    [
        ("application/json", b"{}", 415),
        ('multipart/related; type="application/dicom+json"; boundary=edge', body(b"{}"), 415),
        (RELATED, body(b"x", content_type=""), 415),
        (RELATED, body(b"x", content_type="Content-Type: text/plain\r\n"), 415),
        ('multipart/related; type="application/dicom"', body(b"x"), 400),
        (RELATED.replace("edge", "other"), body(b"x"), 400),
        (RELATED, body(b"x", end=b""), 400),
        (RELATED, b"", 400),
        (RELATED, b"--edge--\r\n", 400),
    ],
)
def test_bad_requests_store_nothing(service: TestClient, content_type: str, content: bytes, status: int) -> None:
    answer = service.post(STUDIES, content=content, headers={"content-type": content_type})
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert (stored_count(), left_files()) == (0, [])


@pytest.mark.parametrize(
    ("head", "tail"),
    [
        (b"A preamble that readers ignore\r\n--edge\r\n", b"\r\n--edge--\r\n"),
        (b"--edge \r\n", b"\r\n--edge--\r\n"),
        (b"--edge\r\n", b"\r\n--edge-- \t\r\nAn epilogue, also with --edge in it"),
        (b"\r\n--edge\t\r\nContent-Length: 7\r\n", b"\r\n--edge--"),
        (b"--edge\nContent-Location: a\n", b"\n--edge--\n"),
    ],
    ids=["preamble", "blank", "epilogue", "length", "line feeds"],
)
@pytest.mark.parametrize("content_type", [RELATED, 'Multipart/Related; boundary="edge"; type=application/dicom'])
def test_bodies_as_rfc_2046_allows_them(
    service: TestClient, tmp_path: Path, head: bytes, tail: bytes, content_type: str
) -> None:
    file = small_run(tmp_path, 1, 0.0)
    end = b"\n\n" if b"\r" not in head else b"\r\n\r\n"
    content = head + b"Content-Type: application/dicom" + end + file + tail
    answer = service.post(STUDIES, content=content, headers={"content-type": content_type})
    assert answer.status_code == 200, answer.text
    assert parts_of(service.get(address(file))) == [file]


def test_failed_items_have_the_uids_that_can_be_read(service: TestClient, tmp_path: Path) -> None:
    whole = small_run(tmp_path, 1, 0.0)
    xa, computed = "1.2.840.10008.5.1.4.1.1.12.1", "1.2.840.10008.5.1.4.1.1.2"
    files = {
        "signed": edited(whole, PixelRepresentation=1),
        "another kind": edited(whole, SOPClassUID=computed),
        "no rows": edited(whole, Rows=None),
        "pixels cut off": whole[:-500],
        "header cut off": whole[: whole.index(b"\x28\x00\x10\x00US")],
        "no study": edited(whole, StudyInstanceUID=None),
        "no DICOM": b"no DICOM",
        "empty": b"",
        "wrong UID": whole.replace(run_uid(1).encode(), b"X" * len(run_uid(1))),
    }
    answer = store(service, *files.values())
    assert answer.status_code == 409
    items = Dataset.from_json(answer.json()).FailedSOPSequence
    found = {
        name: (item.get("ReferencedSOPClassUID"), item.get("ReferencedSOPInstanceUID"))
        for name, item in zip(files, items, strict=True)
    }
    unreadable = {"no DICOM": (None, None), "empty": (None, None), "wrong UID": (xa, None)}
    kinds = dict.fromkeys(files, (xa, run_uid(1))) | {"another kind": (computed, run_uid(1))} | unreadable
    assert found == kinds
    assert all(item.FailureReason for item in items)


FRAME_SYNTAXES = (
    ExplicitVRLittleEndian, ImplicitVRLittleEndian, DeflatedExplicitVRLittleEndian, ExplicitVRBigEndian, RLELossless,
    JPEGBaseline8Bit, JPEG2000Lossless,
)  # fmt: skip


def recoded(content: bytes, syntax: str, allocated: int, stored: int) -> bytes:
    """Return a run with other pixels, in another transfer syntax."""
    dataset = pydicom.dcmread(io.BytesIO(content))
    pixels = dataset.pixel_array >> (12 - stored)
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = allocated, stored, stored - 1
    dataset.file_meta.TransferSyntaxUID = syntax
    frames = pixels.astype(f"u{allocated // 8}")
    if not syntax.is_compressed or syntax == DeflatedExplicitVRLittleEndian:
        words = frames.byteswap() if syntax == ExplicitVRBigEndian and allocated == 16 else frames
        dataset["PixelData"] = DataElement(0x7FE00010, "OW" if allocated == 16 else "OB", words.tobytes())
    else:
        dataset.PixelData = encapsulate([coded(frame, syntax, stored) for frame in frames])
        dataset["PixelData"].VR = "OB"
        dataset["PixelData"].is_undefined_length = True
    stream = io.BytesIO()
    pydicom.dcmwrite(stream, dataset, enforce_file_format=True)
    return stream.getvalue()


def coded(frame: NDArray[Any], syntax: str, stored: int) -> bytes:
    if syntax == RLELossless:
        bits = frame.dtype.itemsize * 8
        return get_encoder(RLELossless).encode(
            frame, rows=ROWS, columns=COLUMNS, samples_per_pixel=1, bits_allocated=bits, bits_stored=bits,
            pixel_representation=0, photometric_interpretation="MONOCHROME2", number_of_frames=1, encoding_plugin="pydicom",
        )  # fmt: skip
    stream = io.BytesIO()
    picture = Image.fromarray(frame.astype(np.uint8) if stored <= 8 else frame)
    if syntax == JPEG2000Lossless:
        picture.save(stream, "JPEG2000", irreversible=False, no_jp2=True)
    else:
        picture.save(stream, "JPEG", quality=95)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("syntax", "allocated", "stored"),
    [
        pytest.param(syntax, allocated, stored, id=f"{UID(syntax).name}-{allocated}-{stored}")
        for syntax in FRAME_SYNTAXES
        for allocated, stored in [(8, 8), (8, 7), (16, 8), (16, 12), (16, 5)]
        # JPEG Baseline has 8 bits.
        if syntax != JPEGBaseline8Bit or stored <= 8
    ],
)
def test_frames_have_the_bytes_that_the_header_promises(
    service: TestClient, tmp_path: Path, syntax: UID, allocated: int, stored: int
) -> None:
    file = recoded(small_run(tmp_path, 1, 0.0), syntax, allocated, stored)
    assert store(service, file).status_code == 200
    run = address(file)
    (header,) = found(service, f"{run}/metadata")
    promised = header.Rows * header.Columns * header.SamplesPerPixel * header.BitsAllocated // 8
    frames = parts_of(service.get(f"{run}/frames/1,3,2"))
    assert [len(frame) for frame in frames] == [promised] * 3
    assert [parts_of(service.get(f"{run}/frames/{number}")) for number in (1, 3, 2)] == [[frame] for frame in frames]
    pixels = np.frombuffer(frames[0], f"<u{header.BitsAllocated // 8}").reshape(ROWS, COLUMNS)
    sent = pydicom.dcmread(io.BytesIO(small_run(tmp_path, 1, 0.0))).pixel_array[0] >> (12 - stored)
    assert np.abs(pixels.astype(int) - sent).max() <= (40 if syntax == JPEGBaseline8Bit else 0)


@pytest.mark.parametrize(
    ("query", "count"),
    [
        ("", 1), ("?PatientID=P7", 1), ("?PatientID=P8", 0), ("?PatientName=doe*", 1), ("?PatientName=D?e^Jane", 1),
        ("?00100010=Smith*", 0), (f"?StudyInstanceUID=1.2,{STUDY_UID}", 1), ("?StudyDate=20260228-20260302", 1),
        ("?StudyDate=-20260228", 0), ("?StudyDate=20260301", 1), ("?ModalitiesInStudy=XA&limit=5&fuzzymatching=false", 1),
        ("?offset=1", 0), ("?limit=0", 0), ("?AccessionNumber=", 1),
    ],
)  # fmt: skip
def test_searches_for_studies(service: TestClient, two_runs: list[bytes], query: str, count: int) -> None:
    assert len(found(service, STUDIES + query)) == count


def test_study_series_and_instance_levels(service: TestClient, two_runs: list[bytes]) -> None:
    (study,) = found(service, f"{STUDIES}?includefield=Manufacturer")
    assert (study.PatientName, study.ModalitiesInStudy) == ("Doe^Jane", "XA")
    assert (study.NumberOfStudyRelatedSeries, study.NumberOfStudyRelatedInstances) == (2, 2)
    assert study.Manufacturer == pydicom.dcmread(io.BytesIO(two_runs[0])).Manufacturer
    series = found(service, f"{STUDIES}/{STUDY_UID}/series")
    assert {item.SeriesNumber for item in series} == {1, 2}
    (instance,) = found(service, f"{STUDIES}/{STUDY_UID}/series/{series[0].SeriesInstanceUID}/instances")
    assert (instance.Rows, instance.Columns, instance.NumberOfFrames) == (ROWS, COLUMNS, FRAMES)
    assert len(found(service, f"{STUDIES}/{STUDY_UID}/instances")) == len(found(service, "/dicom-web/instances")) == 2
    assert len(found(service, "/dicom-web/series?SeriesNumber=2")) == 1
    assert len(found(service, "/dicom-web/instances?limit=1")) == 1


def test_unknown_parameters_are_refused(service: TestClient, two_runs: list[bytes]) -> None:
    for path in (STUDIES, f"{STUDIES}/{STUDY_UID}/metadata", f"{STUDIES}/{STUDY_UID}"):
        answer = service.get(f"{path}?PatientNaem=Doe")
        assert (answer.status_code, answer.json()["code"]) == (422, "unknown_parameter")
    assert service.get(f"{STUDIES}?limit=many").status_code == 422


def test_files_come_back_as_they_were_sent(service: TestClient, two_runs: list[bytes]) -> None:
    accept = {"accept": 'multipart/related; type="application/dicom"; transfer-syntax=*'}
    assert sorted(parts_of(service.get(f"{STUDIES}/{STUDY_UID}", headers=accept))) == sorted(two_runs)
    assert parts_of(service.get(address(two_runs[0]), headers=accept)) == [two_runs[0]]
    series = address(two_runs[1]).partition("/instances")[0]
    assert parts_of(service.get(series)) == [two_runs[1]]


def test_headers_come_without_pixels(service: TestClient, two_runs: list[bytes]) -> None:
    (header,) = found(service, f"{address(two_runs[0])}/metadata")
    sent = pydicom.dcmread(io.BytesIO(two_runs[0]))
    del sent.PixelData
    assert header == sent
    assert len(found(service, f"{STUDIES}/{STUDY_UID}/metadata")) == 2


def test_frames_are_the_stored_pixels(service: TestClient, two_runs: list[bytes]) -> None:
    sent = pydicom.dcmread(io.BytesIO(two_runs[0])).pixel_array
    frames = parts_of(service.get(f"{address(two_runs[0])}/frames/3,1"))
    assert [np.frombuffer(frame, "<u2").reshape(ROWS, COLUMNS).tolist() for frame in frames] == [
        sent[2].tolist(),
        sent[0].tolist(),
    ]


def test_rendered_frames_follow_the_photometric_interpretation(service: TestClient, tmp_path: Path) -> None:
    pictures = []
    for number, interpretation in ((1, "MONOCHROME1"), (2, "MONOCHROME2")):
        file = edited(small_run(tmp_path, number, 0.0), PhotometricInterpretation=interpretation)
        assert store(service, file).status_code == 200
        answer = service.get(f"{address(file)}/frames/2/rendered?window=2048,4096,linear-exact&accept=image/png")
        stored = pydicom.dcmread(io.BytesIO(file)).pixel_array[1] / 4096 * 255
        shown = np.asarray(Image.open(io.BytesIO(answer.content)), dtype=np.float64)
        pictures.append((shown, stored))
    (inverted, first), (plain, second) = pictures
    np.testing.assert_allclose(255 - inverted, first, atol=0.51)
    np.testing.assert_allclose(plain, second, atol=0.51)


def test_what_is_not_there_or_not_offered(service: TestClient, two_runs: list[bytes]) -> None:
    run = address(two_runs[0])
    assert service.get(f"{STUDIES}/1.2.3").status_code == 404
    assert service.get(f"{run}/frames/4").status_code == 404
    assert service.get(f"{run}/frames/x").status_code == 400
    # A reader must not keep the service at work by a list without end.
    assert service.get(f"{run}/frames/1,2,3").status_code == 200
    assert service.get(f"{run}/frames/1,2,3,1").status_code == 400
    for accept in ("image/jpeg", 'multipart/related; type="application/dicom"; transfer-syntax=1.2.840.10008.1.2.4.50'):
        assert service.get(run, headers={"accept": accept}).status_code == 406
    assert service.get(f"{run}/frames/1", headers={"accept": "multipart/related; type=image/jpeg"}).status_code == 406


def test_one_of_several_accepted_types_is_enough(service: TestClient, two_runs: list[bytes]) -> None:
    accept = (
        'multipart/related; type="image/jpeg"; transfer-syntax=1.2.840.10008.1.2.4.50, '
        'multipart/related; type="application/octet-stream"'
    )
    assert len(parts_of(service.get(f"{address(two_runs[0])}/frames/1", headers={"accept": accept}))) == 1
