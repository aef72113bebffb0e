"""The matching of QIDO-RS, on both databases (PS3.4 section C.2.2.2, PS3.18 section 8.3.4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

import pytest
from dicom_service import STUDIES, found, service_on, store
from fastapi.testclient import TestClient
from pydicom.dataset import Dataset
from small_runs import edited, small_run

from fluoromap_service.dicom.indexed_header import MOST_VALUES

Fresh = Callable[[], AbstractContextManager[str]]

UIDS = ("1.2.3.1", "1.2.3.2", "1.2.3.3")
"""Study Instance UIDs of the three runs."""


def _issuer(identifier: str, issuer: str) -> Dataset:
    item = Dataset()
    item.PatientID, item.IssuerOfPatientID = identifier, issuer
    return item


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def archive(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, fresh_postgres: Fresh
) -> Iterator[TestClient]:
    """Three DICOM studies of one run each."""
    folder = tmp_path_factory.mktemp("archive")
    with pytest.MonkeyPatch.context() as monkeypatch:
        stack = ExitStack()
        url = stack.enter_context(fresh_postgres()) if request.param == "postgresql" else ""
        with stack, service_on(url, folder, monkeypatch) as service:
            runs = [small_run(folder, number, 30.0 * number) for number in (1, 2, 3)]
            files = [
                edited(
                    runs[0], StudyInstanceUID=UIDS[0], PatientName="DOE^JOHN^^", PatientID="A_1", StudyDate="20240105",
                    StudyTime="101112", ImageType=["ORIGINAL", "PRIMARY", "SINGLE PLANE"], StudyDescription="50% [left] a_b",
                    SeriesNumber=7, OtherPatientIDsSequence=[_issuer("X1", "EAST"), _issuer("X2", "WEST")],
                    AcquisitionDateTime="20240105101500.5+0100", PerformedProcedureStepStartDate="20240105",
                ),
                edited(
                    runs[1], StudyInstanceUID=UIDS[1], SpecificCharacterSet=["", "ISO 2022 IR 87"],
                    PatientName="Yamada^Tarou=山田^太郎=やまだ^たろう", PatientID="a_1", StudyDate="20240106",
                    StudyTime="223015.250000", AcquisitionDateTime=None, ImageType=["DERIVED", "SECONDARY"], StudyDescription="*?",
                ),
                edited(
                    runs[2], StudyInstanceUID=UIDS[2], PatientName="Doe^Jane^M", PatientID="AB1", StudyDate="20240107",
                    StudyTime="22", StudyDescription="A" * 64, ImageType="OTHER", AcquisitionDateTime=None,
                ),
            ]  # fmt: skip
            answer = store(service, *files)
            assert answer.status_code == 200, answer.text
            yield service


def numbers(service: TestClient, query: str) -> set[int]:
    """Return which of the three studies a search finds."""
    return {UIDS.index(each["0020000D"]["Value"][0]) + 1 for each in found(service, f"{STUDIES}?{query}")}


@pytest.mark.parametrize(
    ("query", "wanted"),
    [
        # Every value of a list counts.
        ("ImageType=PRIMARY", {1}), ("ImageType=SINGLE PLANE", {1}), ("ImageType=SECONDARY", {2}),
        ("ImageType=PRIM*", {1}), ("00080008=?RIMARY", {1}), ("ImageType=PRIMARY,SECONDARY", {1, 2}),
        ("ImageType=primary", set()),
        # Names: any group, without regard to case and to empty components at the end.
        ("PatientName=DOE^JOHN", {1}), ("PatientName=doe^john^^^^", {1}), ("PatientName=DOE^JOHN^*", {1}),
        ("PatientName=DOE^*", {1, 3}), ("PatientName=DOE^*^*", {1, 3}), ("PatientName=*^J*", {1, 3}),
        ("PatientName=DOE", set()),
        ("PatientName=山田*", {2}), ("PatientName=*太郎", {2}), ("PatientName=山?^太郎", {2}), ("PatientName=やまだ^たろう", {2}),
        ("PatientName=yamada^*", {2}), ("PatientName=Yamada^Tarou=山田^太郎=*", {2}), ("PatientName=*=山田*", {2}),
        ("PatientName=Yamada^Tarou=田中*", set()),
        # Texts: case counts, and what SQL takes for a wildcard does not.
        ("PatientID=A_1", {1}), ("PatientID=a_1", {2}), ("PatientID=?_1", {1, 2}), ("PatientID=A?1", {1, 3}),
        ("PatientID=A*", {1, 3}),
        ("PatientID=%25", set()), ("PatientID=A%251", set()), ("StudyDescription=50%25*", {1}),
        ("StudyDescription=*[left]*", {1}),
        ("StudyDescription=*[a-z]*", set()), ("StudyDescription=*a_b", {1}), ("StudyDescription=*\\_*", set()),
        ("PatientID=*", {1, 2, 3}), ("PatientID=***", {1, 2, 3}), ("PatientID=", {1, 2, 3}), ("PatientID=%00", {1, 2, 3}),
        ("PatientID=??1", {1, 2, 3}), ("PatientID=????", set()), ("PatientID=*????", set()),
        (f"StudyDescription={'A' * 64}", {3}),
        (f"StudyDescription={'*?' * 32}", {3}), (f"StudyDescription={'*?' * 65}", set()),
        (f"StudyDescription={'*A' * 40}~", set()),
        (f"StudyDescription={'A' * 5000}", set()), ("PatientID= A_1 ", {1}),
        # Lists of UIDs.
        (f"StudyInstanceUID={UIDS[0]},{UIDS[2]}", {1, 3}), (f"StudyInstanceUID={UIDS[0]}\\{UIDS[1]}", {1, 2}),
        ("SOPClassUID=1.2.840.10008.5.1.4.1.1.12.1,1.2", {1, 2, 3}), ("SOPClassUID=1.2", set()),
        # Dates and times: a value covers the time that its precision leaves open.
        ("StudyDate=20240105", {1}), ("StudyDate=2024.01.05", {1}), ("StudyDate=20240105-20240106", {1, 2}),
        ("StudyDate=-20240106", {1, 2}), ("StudyDate=20240106-", {2, 3}), ("StudyDate=202401", {1, 2, 3}),
        ("StudyDate=2023", set()),
        ("StudyTime=1011", {1}), ("StudyTime=10:11:12", {1}), ("StudyTime=101112.000000", {1}), ("StudyTime=101113", set()),
        ("StudyTime=2230", {2, 3}), ("StudyTime=1000-1100", {1}), ("StudyTime=223015.25-223016", {2, 3}),
        ("StudyTime=-12", {1}),
        ("StudyTime=223016-", {3}), ("AcquisitionDateTime=20240105091500.5", {1}),
        ("AcquisitionDateTime=20240105101500.5%2B0100", {1}),
        ("AcquisitionDateTime=202401051015", set()), ("AcquisitionDateTime=20240105-20240106", {1}),
        ("AcquisitionDateTime=202401050915-202401050916", {1}), ("AcquisitionDateTime=2024010511-", set()),
        ("StudyDate=20240105-20240106&StudyTime=1100-2300", {2}), ("StudyDate=20240105-20240106&StudyTime=1000-2200", {1}),
        ("StudyDate=20240104-20240106&StudyTime=2300-1000", {1}), ("StudyDate=20240105-20240106&StudyTime=2230", {2}),
        # Numbers have many texts.
        ("SeriesNumber=7", {1}), ("SeriesNumber=007", {1}), ("SeriesNumber=7.0", {1}), ("Rows=48", {1, 2, 3}),
        ("Rows=4?", {1, 2, 3}),
        # Sequences: all keys match in the same item.
        ("00101002.00100020=X1", {1}), ("OtherPatientIDsSequence.PatientID=X*", {1}), ("00101002.00100020=X3", set()),
        ("00101002.00100020=X1&00101002.00100021=EAST", {1}), ("00101002.00100020=X1&00101002.00100021=WEST", set()),
        ("PatientID=X1", set()),
        # Attributes that the service computes.
        ("ModalitiesInStudy=XA", {1, 2, 3}), ("ModalitiesInStudy=SR", set()), ("ModalitiesInStudy=SR\\XA", {1, 2, 3}),
        ("SOPClassesInStudy=1.2.840.10008.5.1.4.1.1.12.1", {1, 2, 3}), ("SOPClassesInStudy=1.2", set()),
        ("InstanceAvailability=ONLINE", {1, 2, 3}), ("InstanceAvailability=ON*", {1, 2, 3}),
        ("InstanceAvailability=OFFLINE", set()),
        # Several keys, and a key twice.
        ("PatientName=DOE*&StudyDate=20240107-", {3}), ("PatientID=A*&PatientID=*B*", {3}),
        (f"StudyInstanceUID={UIDS[0]}&PatientName=Yamada*", set()),
    ],
)  # fmt: skip
def test_matching(archive: TestClient, query: str, wanted: set[int]) -> None:
    assert numbers(archive, query) == wanted


@pytest.mark.parametrize(
    ("query", "code"),
    [
        ("NumberOfStudyRelatedInstances=1", "unsupported_key"), ("RetrieveURL=x", "unsupported_key"),
        ("PixelData=x", "unsupported_key"),
        ("OtherPatientIDsSequence=x", "unsupported_key"), ("52009230.00209111.00189074=2024", "unsupported_key"),
        ("RetrieveAETitle=x", "unsupported_key"), ("PatientNaem=Doe", "unknown_parameter"),
        ("00101002.Nothing=x", "unknown_parameter"),
        ("0010.0020=x", "unknown_parameter"), ("includefield=Nothing", "unknown_parameter"), ("StudyDate=yesterday", "invalid"),
        ("StudyDate=-", "invalid"), ("StudyTime=2x", "invalid"), ("SeriesNumber=seven", "invalid"), ("limit=-1", "invalid"),
        ("StudyInstanceUID=" + ",".join(f"1.{number}" for number in range(1001)), "invalid"),
        ("&".join(f"PatientID={number}" for number in range(101)), "invalid"),
    ],
)  # fmt: skip
def test_a_key_that_is_not_matched_is_named(archive: TestClient, query: str, code: str) -> None:
    answer = archive.get(f"{STUDIES}?{query}")
    assert (answer.status_code, answer.json()["code"]) == (422, code)
    if "&" not in query and "includefield" not in query:
        assert query.partition("=")[0] in str(answer.json()["errors"])


def test_attributes_of_a_study(archive: TestClient) -> None:
    (study,) = found(
        archive,
        f"{STUDIES}?StudyInstanceUID={UIDS[1]}&includefield=SOPClassesInStudy,ImageType,OtherPatientIDsSequence",
    )
    assert study["00080061"]["Value"] == ["XA"]
    assert study["00080062"]["Value"] == ["1.2.840.10008.5.1.4.1.1.12.1"]
    assert study["00080056"]["Value"] == ["ONLINE"]
    assert study["00080008"]["Value"] == ["DERIVED", "SECONDARY"]
    assert (study["00201206"]["Value"], study["00201208"]["Value"]) == ([1], [1])
    assert study["00100010"]["Value"] == [
        {"Alphabetic": "Yamada^Tarou", "Ideographic": "山田^太郎", "Phonetic": "やまだ^たろう"}
    ]
    assert list(study) == sorted(study)


def test_fuzzy_matching_is_told(archive: TestClient) -> None:
    assert "Warning" not in archive.get(f"{STUDIES}?fuzzymatching=false").headers
    assert "fuzzymatching parameter is not supported" in archive.get(f"{STUDIES}?fuzzymatching=true").headers["Warning"]


def test_pages_follow_the_uids(archive: TestClient) -> None:
    pages = [archive.get(f"/dicom-web/instances?limit=2&offset={offset}") for offset in (0, 2, 3, 999_999_999)]
    assert [page.status_code for page in pages] == [200, 200, 204, 204]
    uids = [each["0020000D"]["Value"][0] for page in pages[:2] for each in page.json()]
    assert uids == list(UIDS)
    assert ["more results" in page.headers.get("Warning", "") for page in pages] == [True, False, False, False]


def test_a_header_with_very_many_values_is_found_by_the_first(service: TestClient, tmp_path: Path) -> None:
    items = [_issuer(f"I{number}", "HERE") for number in range(MOST_VALUES)]
    file = edited(small_run(tmp_path, 1, 0.0), PatientID="P1", OtherPatientIDsSequence=items)
    assert store(service, file).status_code == 200
    assert len(found(service, f"{STUDIES}?PatientID=P1")) == 1
    assert len(found(service, f"{STUDIES}?00101002.00100020=I0")) == 1
    answer = service.get(f"{STUDIES}?00101002.00100020=I{MOST_VALUES - 1}")
    assert answer.status_code == 204
    assert "could not be compared" in answer.headers["Warning"]
    (whole,) = found(service, f"{STUDIES}?includefield=all")
    assert "00101002" not in whole
    (metadata,) = service.get(f"{STUDIES}/{whole['0020000D']['Value'][0]}/metadata").json()
    assert len(metadata["00101002"]["Value"]) == MOST_VALUES
