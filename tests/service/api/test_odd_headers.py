"""What a door accepts, every reader survives: no stored object changes the answer to a request about another one."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pydicom
import pytest
from dicom_service import STUDIES, found, store
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_runs import STUDY_UID, edited, small_run

from fluoromap_service.api.http import file_pool
from fluoromap_service.dicom import deterministic_uid

LONG_LENGTH = frozenset({"OB", "OD", "OF", "OL", "OV", "OW", "SQ", "SV", "UC", "UN", "UR", "UT", "UV"})
"""Representations whose length has four bytes (PS3.5 section 7.1.2)."""
ITEM, ITEM_END, SEQUENCE_END = (struct.pack("<HHL", 0xFFFE, tag, 0) for tag in (0xE000, 0xE00D, 0xE0DD))
OPEN_ITEM = ITEM[:4] + b"\xff" * 4
OTHER_STUDY = deterministic_uid("odd", "study")

Element = tuple[int, str, bytes]


def element(tag: int, vr: str, value: bytes) -> bytes:
    """Return an element of explicit VR, little endian.

    Its value may be any bytes.
    """
    group, number = tag >> 16, tag & 0xFFFF
    if vr in LONG_LENGTH:
        return struct.pack("<HH2sHL", group, number, vr.encode(), 0, len(value)) + value
    return struct.pack("<HH2sH", group, number, vr.encode(), len(value)) + value


def open_sequence(tag: int) -> bytes:
    """Return the beginning of a sequence without a length; a delimiter ends it."""
    return struct.pack("<HH2sHL", tag >> 16, tag & 0xFFFF, b"SQ", 0, 0xFFFFFFFF)


def with_bytes(file: bytes, added: bytes) -> bytes:
    """Return the file with bytes before its pixel data.

    Of two elements with one tag, readers take the second.
    """
    at = file.rindex(struct.pack("<HH", 0x7FE0, 0x0010) + b"OW")
    return file[:at] + added + file[at:]


def strict(text: str) -> Any:
    """Return the value of a JSON text.

    NaN and infinity, which JSON lacks, are an error.
    """

    def refuse(name: str) -> Any:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.fixture(scope="module", autouse=True)
def _file_processes() -> Iterator[None]:
    yield
    file_pool.close()


CASES = {
    "stray sequence delimiter": SEQUENCE_END,
    "stray item": element(0x00081140, "SQ", b"") + ITEM + element(0x00081150, "UI", b"1.2\0"),
    "NaN in FD": element(0x00189074, "FD", struct.pack("<2d", float("nan"), 3.0)),
    "infinity in FL": element(0x00181405, "FL", struct.pack("<f", float("inf"))),
    "NaN in DS": element(0x00181110, "DS", b"NaN "),
    "infinite DS": element(0x00181111, "DS", b"1e999 "),
    "text in DS": element(0x00181030, "DS", b"abcd"),
    "decimals in IS": element(0x00200013, "IS", b"1.5 "),
    "half a short": element(0x00280106, "US", b"\1"),
    "half a tag": element(0x00280009, "AT", b"\x18\0\x63"),
    "five groups of a name": element(0x00100010, "PN", b"A^B=C=D=E=F "),
    "no UTF-8": element(0x00080005, "CS", b"ISO_IR 192") + element(0x00100010, "PN", b"\xff\xfe\xc3^\x80\x81"),
    "unknown character set": element(0x00080005, "CS", b"ISO_IR 999") + element(0x00100010, "PN", b"M\xdcLLER"),
    "NUL in a text": element(0x00081030, "LO", b"a\0b\0"),
    "unknown representation": element(0x00081030, "ZZ", b"ab"),
    "group length": element(0x00080000, "UL", struct.pack("<L", 7)),
    "a date that is none": element(0x00080020, "DA", b"tomorrow"),
    "deep sequences": (open_sequence(0x0040A730) + OPEN_ITEM) * 40 + (ITEM_END + SEQUENCE_END) * 40,
    "endless sequences": (open_sequence(0x0040A730) + OPEN_ITEM) * 2000 + (ITEM_END + SEQUENCE_END) * 2000,
    "a sequence without end": open_sequence(0x00081140) + ITEM,
    "a long text": element(0x00104000, "UT", b"x" * 300_000),
    "binary": element(0x00091001, "UN", bytes(range(256))) + element(0x00283006, "OW", bytes(5000)),
}  # fmt: skip


def answers(service: TestClient, study: str, run: str) -> dict[str, Any]:
    """Return the answers to the requests about a run.

    Of the answers over the archive it returns the part about the run.
    """
    series = found(service, f"/dicom-web/instances?SOPInstanceUID={run}")[0]["0020000E"]["Value"][0]
    address = f"{STUDIES}/{STUDY_UID}/series/{series}"
    instance = f"{address}/instances/{run}"
    paths = [
        f"{instance}/metadata", instance, f"{instance}/frames/1", f"{instance}/rendered", f"{address}/metadata",
        f"{address}/instances", f"/dicom-web/studies?SeriesInstanceUID={series}",
        f"/dicom-web/series?SeriesInstanceUID={series}", f"/dicom-web/instances?SOPInstanceUID={run}&includefield=all",
        "/dicom-web/studies?PatientID=GOOD&PatientName=DOE^*", "/dicom-web/instances?PatientID=GOOD&StudyDate=2026-",
        "/dicom-web/studies?PatientID=NOBODY", "/dicom-web/series?Modality=SR",
        f"{study}/instances/{run}", f"{study}/instances/{run}/frames/1.png", f"{study}/sites",
    ]  # fmt: skip
    given = {path: service.get(path) for path in paths}
    wholes = {
        path: [service.get(path).json()] for path in ("/dicom-web/instances?includefield=all", "/dicom-web/instances")
    }
    own = {path: [entry for entry in page[0] if entry["00080018"]["Value"] == [run]] for path, page in wholes.items()}
    return {path: (answer.status_code, answer.content) for path, answer in given.items()} | own


class GoodRun:
    """A stored run, another one that is made odd, and the answers about the first while the other has a good header."""

    def __init__(self, service: TestClient, study: str, run: str, files: dict[str, bytes]) -> None:
        self.service, self.files = service, files
        self._study, self._run = study, run
        self._before: dict[str | None, dict[str, Any]] = {None: answers(service, study, run)}
        for study_uid, file in files.items():
            with odd_run(service, file, b""):
                self._before[study_uid] = answers(service, study, run)

    def check(self, study_uid: str | None, name: str) -> None:
        """Check that the answers about the good run are as before.

        ``study_uid`` is the DICOM study of the odd run; None where the door refused it.
        """
        for path, answer in answers(self.service, self._study, self._run).items():
            # Pairing reads the header of every run of a mapping study.
            if study_uid != STUDY_UID or not path.startswith("/v1"):
                assert answer == self._before[study_uid][path], (name, path)


@pytest.fixture
def good(service: TestClient, tmp_path: Path) -> GoodRun:
    """A good run, and files of another one in the same DICOM study and in another study."""
    file = edited(small_run(tmp_path, 1, 0.0), PatientID="GOOD", PatientName="DOE^JOHN")
    assert store(service, file).status_code == 200
    run = str(pydicom.dcmread(io.BytesIO(file)).SOPInstanceUID)
    study = f"/v1/studies/{service.get('/v1/studies').json()['items'][0]['id']}"
    other = small_run(tmp_path, 2, 90.0)
    return GoodRun(service, study, run, {STUDY_UID: other, OTHER_STUDY: edited(other, StudyInstanceUID=OTHER_STUDY)})


@contextmanager
def odd_run(service: TestClient, file: bytes, added: bytes) -> Iterator[str | None]:
    """Store a run with added bytes, and delete it at the end.

    Yield its UID, or None where the door refuses it.
    """
    answer = store(service, with_bytes(file, added))
    assert answer.status_code in (200, 409), answer.text
    header = pydicom.dcmread(io.BytesIO(file), stop_before_pixels=True)
    if answer.status_code == 409:
        yield None
        return
    try:
        yield str(header.SOPInstanceUID)
    finally:
        for study in service.get("/v1/studies").json()["items"]:
            path = f"/v1/studies/{study['id']}/instances/{header.SOPInstanceUID}"
            service.delete(path)


def check_own(service: TestClient, uid: str) -> None:
    """Check that the run itself is found, and that its header is JSON."""
    answer = service.get(f"/dicom-web/instances?SOPInstanceUID={uid}&includefield=all")
    assert answer.status_code == 200, answer.text
    (entry,) = strict(answer.text)
    study, series = entry["0020000D"]["Value"][0], entry["0020000E"]["Value"][0]
    metadata = service.get(f"{STUDIES}/{study}/series/{series}/instances/{uid}/metadata")
    assert metadata.status_code == 200, metadata.text
    (header,) = strict(metadata.text)
    assert header["00080018"]["Value"] == [uid]
    assert header["00280010"]["Value"] == [48]


@pytest.mark.parametrize("study_uid", [STUDY_UID, OTHER_STUDY], ids=["same study", "other study"])
def test_known_oddities_change_no_other_answer(good: GoodRun, study_uid: str) -> None:
    refused = []
    for name, added in CASES.items():
        with odd_run(good.service, good.files[study_uid], added) as uid:
            if uid is None:
                refused.append(name)
            else:
                check_own(good.service, uid)
            good.check(None if uid is None else study_uid, name)
    assert refused == ["unknown representation", "endless sequences", "a sequence without end"]


def in_item(tag: int, vr: str, value: bytes) -> bytes:
    """Return a sequence of one item with one element."""
    nested = element(0x00080100, vr, value)
    return element(tag, "SQ", ITEM[:4] + struct.pack("<L", len(nested)) + nested)


representations = st.sampled_from(
    ["AE", "AS", "AT", "CS", "DA", "DS", "DT", "FD", "FL", "IS", "LO", "LT", "OB", "OW", "PN", "SH", "SL", "SQ", "SS", "ST",
     "SV", "TM", "UC", "UI", "UL", "UN", "UR", "US", "UT", "UV", "ZZ"]
)  # fmt: skip
tags = st.sampled_from(
    [0x00080005, 0x00080008, 0x00080020, 0x00080030, 0x00080050, 0x00080061, 0x00081030, 0x00081140, 0x00091001, 0x00100010,
     0x00100020, 0x00101002, 0x00181030, 0x00189074, 0x00200011, 0x00200013, 0x00280106, 0x00281050, 0x00400244, 0x00400275,
     0x00880200, 0x52009229, 0x52009230]
)  # fmt: skip
texts = st.sampled_from(
    [b"NaN", b"-inf", b"1e999", b"1.5", b"ISO_IR 192", b"\\ISO 2022 IR 87", b"\x1b$B;3\x1b(B", b"^=^=^=", b"\\" * 9]
)
values = st.one_of(
    st.binary(max_size=40), texts, st.just(struct.pack("<d", float("nan"))), st.text(max_size=20).map(str.encode)
)
oddities = st.lists(
    st.one_of(
        st.builds(element, tags, representations, values),
        st.builds(in_item, tags, st.sampled_from(["SH", "LO", "DS", "FD", "US"]), st.binary(max_size=20)),
        st.sampled_from([ITEM, ITEM_END, SEQUENCE_END]),
    ),
    min_size=1, max_size=6,
).map(b"".join)  # fmt: skip


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(added=oddities, study_uid=st.sampled_from([STUDY_UID, OTHER_STUDY]))
def test_no_accepted_object_changes_the_answer_about_another(good: GoodRun, added: bytes, study_uid: str) -> None:
    with odd_run(good.service, good.files[study_uid], added) as uid:
        if uid is not None:
            check_own(good.service, uid)
        good.check(None if uid is None else study_uid, "any")


def test_an_attribute_that_is_left_out_is_told(service: TestClient, tmp_path: Path) -> None:
    file = with_bytes(small_run(tmp_path, 1, 0.0), element(0x00200013, "IS", b"abcd"))
    assert store(service, file).status_code == 200
    answer = service.get(f"{STUDIES}?includefield=all")
    assert answer.status_code == 200
    assert "could not be read" in answer.headers["Warning"]
    searched = service.get("/dicom-web/instances?InstanceNumber=1")
    assert searched.status_code == 204
    assert "could not be compared" in searched.headers["Warning"]
    assert "Warning" not in service.get("/dicom-web/instances?PatientID=NOBODY").headers


def test_numbers_that_json_lacks_are_null(service: TestClient, tmp_path: Path) -> None:
    assert store(service, with_bytes(small_run(tmp_path, 1, 0.0), CASES["NaN in FD"])).status_code == 200
    (header,) = strict(service.get(f"{STUDIES}/{STUDY_UID}/metadata").text)
    assert header["00189074"]["Value"] == [None, 3.0]
