"""Content negotiation of DICOMweb: media types, weights, wildcards and damaged Accept headers (PS3.18 section 8.7)."""

from __future__ import annotations

import io
from pathlib import Path

import pydicom
import pytest
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_runs import COLUMNS, ROWS, STUDY_UID, small_run

from fluoromap_service.api.dicomweb.accept import media_ranges

STUDY = f"/dicom-web/studies/{STUDY_UID}"
PLAIN = "1.2.840.10008.1.2.1"


@pytest.fixture
def run(service: TestClient, tmp_path: Path) -> str:
    """The address of the first of two stored runs, each in a series of its own."""
    files = [small_run(tmp_path, number, 0.0) for number in (1, 2)]
    content = b"".join(b"--edge\r\nContent-Type: application/dicom\r\n\r\n" + file + b"\r\n" for file in files)
    headers = {"content-type": 'multipart/related; type="application/dicom"; boundary=edge'}
    assert service.post("/dicom-web/studies", content=content + b"--edge--", headers=headers).status_code == 200
    first = pydicom.dcmread(io.BytesIO(files[0]))
    return f"{STUDY}/series/{first.SeriesInstanceUID}/instances/{first.SOPInstanceUID}"


RELATED, SINGLE = "multipart/related", "one part"


@pytest.mark.parametrize(
    ("accept", "answer"),
    [
        (None, RELATED), ("", RELATED), ("*/*", RELATED), ("multipart/*", RELATED), ("multipart/related", RELATED),
        ("{related}", RELATED), ('multipart/related; type="{kind}"; transfer-syntax=*', RELATED),
        (f'multipart/related; type="{{kind}}"; transfer-syntax="{PLAIN}"', RELATED),
        ("MULTIPART/Related;TYPE={kind}", RELATED), ("multipart/related; type=*/*", RELATED),
        ("{kind}", SINGLE), ("{kind}; transfer-syntax=*", SINGLE), (f"{{kind}};transfer-syntax={PLAIN}", SINGLE),
        ("application/*", SINGLE), ("{kind};q=0.5", SINGLE),
        ("{kind}, */*", SINGLE), ("*/*, {kind}", SINGLE), ("{kind};q=0.1, {related};q=0.2", RELATED),
        ("{related};q=0.1, {kind};q=0.2", SINGLE), ("*/*, {related};q=0", SINGLE), ("*/*;q=0.3, {kind};q=0.2", RELATED),
        ("image/jpeg, {kind};q=0.001", SINGLE), ('text/html;x=",", {kind}', SINGLE),
        (f"{{related}}; transfer-syntax=1.2.840.10008.1.2.4.50, {{kind}}; transfer-syntax={PLAIN}", SINGLE),
        ("image/jpeg", 406), ("text/*", 406), ("multipart/related; type=image/jpeg", 406), ("multipart/mixed", 406),
        ("{kind};q=0", 406), ("*/*;q=0", 406), ("*/*, {kind};q=0, {related};q=0", 406), ("application/dicom+xml", 406),
        ("multipart/related; type=application/dicom+xml", 406), ("application/dicom+json", 406),
        ("{kind}; transfer-syntax=1.2.840.10008.1.2.4.50", 406), ("{related}; transfer-syntax=1.2.840.10008.1.2.4.50", 406),
        ("nonsense", 406), ("{kind};q=high", 406), (";;;", 406), ("/", 406), (",", 406), ("{kind", 406),
    ],
)  # fmt: skip
def test_one_part_or_several(service: TestClient, run: str, accept: str | None, answer: str | int) -> None:
    for address, kind in ((run, "application/dicom"), (f"{run}/frames/2", "application/octet-stream")):
        asked = accept
        for word, meaning in (("{related}", f"multipart/related; type={kind}"), ("{kind}", kind)):
            asked = asked and asked.replace(word, meaning)
        found = service.get(address, headers={} if asked is None else {"accept": asked})
        if answer == 406:
            assert (found.status_code, found.json()["code"]) == (406, "not_acceptable"), (asked, found.headers)
            continue
        assert found.status_code == 200, (asked, found.text)
        plain = f"{kind}; transfer-syntax={PLAIN}"
        related = found.headers["content-type"].startswith(f'multipart/related; type="{kind}"; boundary=')
        assert (found.headers["content-type"] == plain) == (answer == SINGLE)
        assert related == (answer == RELATED)


def test_a_single_part_is_the_file_or_the_frame(service: TestClient, run: str, tmp_path: Path) -> None:
    file = small_run(tmp_path, 1, 0.0)
    assert service.get(run, headers={"accept": "application/dicom"}).content == file
    series = run.partition("/instances")[0]
    assert service.get(series, headers={"accept": "application/dicom"}).content == file
    frame = service.get(f"{run}/frames/2", headers={"accept": "application/octet-stream"}).content
    assert frame == pydicom.dcmread(io.BytesIO(file)).pixel_array[1].tobytes()
    assert len(frame) == ROWS * COLUMNS * 2


@pytest.mark.parametrize(
    ("path", "accept"), [(STUDY, "application/dicom"), ("{run}/frames/1,2", "application/octet-stream")]
)
def test_several_parts_are_no_single_part(service: TestClient, run: str, path: str, accept: str) -> None:
    address = path.replace("{run}", run)
    answer = service.get(address, headers={"accept": accept})
    assert answer.status_code == 406
    assert "2 parts" in answer.json()["detail"]
    both = service.get(address, headers={"accept": f"{accept}, multipart/related;type={accept};q=0.1"})
    assert both.headers["content-type"].startswith("multipart/related")


@pytest.mark.parametrize(
    ("accept", "answer"),
    [
        (None, "application/dicom+json"), ("*/*", "application/dicom+json"), ("application/*", "application/dicom+json"),
        ("application/dicom+json", "application/dicom+json"), ("application/json", "application/json"),
        ("application/json, application/dicom+json;q=0.5", "application/json"),
        ("application/dicom+xml, */*;q=0.1", "application/dicom+json"),
        ("application/dicom+json;q=0, */*", "application/json"),
        ("application/dicom+xml", None), ('multipart/related; type="application/dicom+xml"', None), ("text/html", None),
        ("application/dicom+json;q=0", None), ("x", None),
    ],
)  # fmt: skip
def test_searches_and_headers_are_json(service: TestClient, run: str, accept: str | None, answer: str | None) -> None:
    for address in (
        "/dicom-web/studies",
        "/dicom-web/series",
        f"{STUDY}/instances",
        f"{STUDY}/metadata",
        f"{run}/metadata",
    ):
        found = service.get(address, headers={} if accept is None else {"accept": accept})
        if answer is None:
            assert (found.status_code, found.json()["code"]) == (406, "not_acceptable"), address
        else:
            assert (found.status_code, found.headers["content-type"]) == (200, answer), address


@pytest.mark.parametrize(
    ("accept", "answer"),
    [
        (None, "image/jpeg"), ("image/png", "image/png"), ("image/jpeg;q=0.5, image/png", "image/png"),
        ("image/png;q=0.5, */*;q=0.4", "image/png"), ("image/gif, image/*;q=0.1", "image/jpeg"), ("image/gif", None),
        ("image/png;q=0", None),
    ],
)  # fmt: skip
def test_pictures(service: TestClient, run: str, accept: str | None, answer: str | None) -> None:
    found = service.get(f"{run}/frames/1/rendered", headers={} if accept is None else {"accept": accept})
    assert found.status_code == (406 if answer is None else 200)
    assert answer is None or found.headers["content-type"] == answer


def test_several_accept_headers_are_one(service: TestClient, run: str) -> None:
    headers = [("accept", "image/jpeg"), ("accept", "application/dicom;q=0.1"), ("accept", "text/html")]
    answer = service.get(run, headers=headers)
    assert answer.headers["content-type"] == f"application/dicom; transfer-syntax={PLAIN}"


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.text("abcq/*+;=,.\"\\ 01", max_size=60)
    | st.lists(
        st.sampled_from(["application/dicom", "*/*", "multipart/related", ";", "type=", '"', ",", ";q=", "0", "1", "2", "é", "\t"])
    ).map("".join)
)  # fmt: skip
def test_no_accept_header_breaks_the_service(service: TestClient, run: str, accept: str) -> None:
    for address in (run, f"{run}/frames/1", f"{run}/metadata", f"{run}/rendered", "/dicom-web/studies"):
        assert service.get(address, headers={"accept": accept.encode("latin-1")}).status_code in (200, 406)


def test_a_long_header_takes_no_long_time() -> None:
    assert media_ranges('"\\' * 30_000) == []
    assert len(media_ranges("a/b;c=d," * 8000)) == 8000
