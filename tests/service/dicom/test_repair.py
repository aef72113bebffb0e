"""Headers that the door accepts and strict readers refuse: results and copies leave, repaired."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydicom.uid import UID
from raw_headers import results_of, strictly_read, with_raw_values
from small_runs import small_run

from fluoromap_service.dicom import HeaderWarning, read_instance
from fluoromap_service.dicom.date_times import date_text, date_time_text, time_text
from fluoromap_service.dicom.deidentification.pseudonyms import Dates, Pseudonyms
from fluoromap_service.dicom.deidentification.run_file import deidentify_file
from fluoromap_service.dicom.objects.identity import source_header
from fluoromap_service.dicom.repair import PATIENT_AND_STUDY
from fluoromap_service.problem import Problem

YAMADA = b"Yamada^Tarou=\x1b$B;3ED\x1b(B^\x1b$BB@O:\x1b(B"
SPRING = b"=\x1b$B=U\x1b(B"  # The second group begins with "=", which is also the first byte of the character.
TOLD = HeaderWarning.PATIENT_OR_STUDY_REPAIRED


@functools.cache
def _run() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return small_run(Path(folder), 1, 30.0)


def _file(folder: Path, values: dict[str, bytes | None]) -> Path:
    path = folder / "run.dcm"
    path.write_bytes(with_raw_values(_run(), values))
    return path


@pytest.mark.parametrize(
    ("terms", "name", "read", "told"),
    [
        (b"\\ISO 2022 IR 87", YAMADA, "Yamada^Tarou=山田^太郎", False),
        (b"\\ISO 2022 IR 87", SPRING, "=春", False),
        (b"ISO 2022 IR 6\\ISO 2022 IR 13\\ISO 2022 IR 87", YAMADA, "Yamada^Tarou=山田^太郎", False),
        (b"ISO_IR 100", YAMADA, "Yamada^Tarou=山田^太郎", False),
        (b"ISO_IR 13", b"\xd4\xcf\xc0\xde^\xc0\xdb\xb3", "ﾔﾏﾀﾞ^ﾀﾛｳ", False),
        (b"", b"TEST^ONE", "TEST^ONE", False),
        (None, b"TEST^ONE", "TEST^ONE", False),
        (b"ISO_IR 6", b"TEST^ONE", "TEST^ONE", True),
        (b"ISO IR 192", "MÜLLER".encode(), "MÜLLER", True),
        (b"ISO_IR_192", "MÜLLER".encode(), "MÜLLER", True),
        (b"utf-8", "MÜLLER".encode(), "MÜLLER", True),
        (b"ISO_IR 192\\ISO 2022 IR 87", "MÜLLER".encode(), "MÜLLER", True),
        (b"ISO_IR 100", b"M\xdcLLER", "MÜLLER", False),
        (b"iso-ir-100", b"M\xdcLLER", "MÜLLER", True),
        (b"ISO 8859-1", b"M\xdcLLER", "MÜLLER", True),
        (b"ISO_IR 192", b"M\xdcLLER", "MÜLLER", True),
        (None, b"M\xdcLLER", "MÜLLER", True),
        (None, "MÜLLER".encode(), "MÜLLER", True),
        (b"KLINGON", b"M\xdcLLER", "MÜLLER", True),
        (b"ISO_IR 149", "김^희중".encode("euc_kr"), "김^희중", True),
        (b"\\ISO 2022 IR 149", b"Hong=\x1b$)C\xfb\xf3^\x1b$)C\xd1\xce\xd4\xd7", "Hong=洪^吉洞", False),
        (b"\\ISO 2022 IR 58", b"Wang=\x1b$)A\xcd\xf5^\x1b$)A\xd0\xa1\xb6\xab", "Wang=王^小东", False),
        (b"GB18030", "Wang=王^小东".encode("gb18030"), "Wang=王^小东", False),
        (b"GBK", "誠^王".encode("gbk"), "誠^王", False),  # The second byte of the first character is a backslash.
        (b"ISO 2022 GBK", "王^小东".encode("gbk"), "王^小东", True),
        (b"ISO_IR 144", "Люкceмбypг".encode("iso8859_5"), "Люкceмбypг", False),
    ],
)  # fmt: skip
def test_names_in_every_character_set(tmp_path: Path, terms: bytes | None, name: bytes, read: str, told: bool) -> None:
    path = _file(tmp_path, {"SpecificCharacterSet": terms, "PatientName": name})
    header = source_header(path)
    assert (str(header.PatientName), header.SpecificCharacterSet) == (read, "ISO_IR 192")
    assert (TOLD in read_instance(path).warnings) is told


@pytest.mark.parametrize(
    ("keyword", "value", "read", "told"),
    [
        *((keyword, None, "", False) for keyword in PATIENT_AND_STUDY if keyword != "StudyInstanceUID"),
        *((keyword, b"", "", False) for keyword in PATIENT_AND_STUDY if keyword != "StudyInstanceUID"),
        ("PatientSex", b"?", "", True),
        ("PatientSex", b"m", "M", True),
        ("PatientSex", b"Female", "F", True),
        ("PatientBirthDate", b"1952.03.17", "19520317", True),
        ("PatientBirthDate", b"1952-3-17", "19520317", True),
        ("PatientBirthDate", b"17.03.1952", "", True),
        ("PatientBirthDate", b"19520230", "", True),
        ("StudyDate", b"20240101-20240105", "", True),
        ("StudyTime", b"10:11:12", "101112", True),
        ("StudyTime", b"9:05", "0905", True),
        ("StudyTime", b"101112.123456789", "101112.123456", True),
        ("StudyTime", b"noon", "", True),
        ("PatientID", b" 0042 ", "0042", False),
        ("PatientID", b"0042\0\0", "0042", False),
        ("PatientID", b"X" * 64, "X" * 64, False),
        ("PatientID", b"X" * 65, "", True),
        ("PatientID", b"12\\34", "", True),
        ("PatientID", b"12\x0134", "", True),
        ("StudyID", b"X" * 17, "", True),
        ("AccessionNumber", b"A-1", "A-1", False),
        ("PatientName", b"A^B^C^D^E^F", "A^B^C^D^E F", True),
        ("PatientName", b"A=B=C=D", "A=B=C", True),
        ("PatientName", b"X" * 70, "X" * 64, True),
        ("PatientName", b"DOE\\JOHN", "DOE JOHN", True),
        ("PatientName", b"DOE^JOHN^^", "DOE^JOHN^^", False),
        ("PatientName", b"DOE\x07^JOHN", "DOE^JOHN", True),
        ("SeriesNumber", b"4.0", "4", False),
        ("SeriesNumber", b"99999999999", "", False),
        ("StudyInstanceUID", b"1.02.003", "1.02.003", False),
        ("StudyInstanceUID", b" 1.2.3 ", "1.2.3", False),
    ],
)  # fmt: skip
def test_values(tmp_path: Path, keyword: str, value: bytes | None, read: str, told: bool) -> None:
    path = _file(tmp_path, {keyword: value})
    header = source_header(path)
    assert str(header[keyword].value or "") == read
    assert (TOLD in read_instance(path).warnings) is told


def test_other_representations_than_those_of_the_dictionary(tmp_path: Path) -> None:
    values: dict[str, bytes | None] = {
        "PatientBirthDate": b"1952.03.17", "PatientName": b"DOE^JOHN", "PatientID": b"4711", "StudyDate": b"20240105",
        "AccessionNumber": b"\xfe\xff\x00\xe0\0\0\0\0",
    }  # fmt: skip
    representations = {
        "PatientBirthDate": "LO", "PatientName": "UN", "PatientID": "OB", "StudyDate": "XX", "AccessionNumber": "SQ",
    }  # fmt: skip
    path = tmp_path / "run.dcm"
    path.write_bytes(with_raw_values(_run(), values, representations))
    header = source_header(path)
    found = [header[keyword].value for keyword in values]
    assert found == ["19520317", "DOE^JOHN", "4711", "20240105", ""]
    assert [header[keyword].VR for keyword in values] == ["DA", "PN", "LO", "DA", "SH"]
    deidentify_file(path, tmp_path / "copy.dcm", Pseudonyms(b"secret", "patient", "", Dates.KEEP))
    assert strictly_read((tmp_path / "copy.dcm").read_bytes()).StudyDate == "20240105"


@pytest.mark.parametrize("value", [b"ab", b"abcd"])
@pytest.mark.parametrize("representation", ["LO", "US", "SQ", "OB", "UN", "AT"])
@pytest.mark.parametrize(
    "keyword",
    ["DeidentificationMethodCodeSequence", "DeidentificationMethod", "PatientIdentityRemoved", "TimezoneOffsetFromUTC",
     "SpecificCharacterSet", "LongitudinalTemporalInformationModified", "StudyInstanceUID", "SOPClassUID"],
)  # fmt: skip
def test_results_of_a_header_with_a_wrong_representation(
    tmp_path: Path, keyword: str, representation: str, value: bytes
) -> None:
    path = tmp_path / "run.dcm"
    path.write_bytes(with_raw_values(_run(), {keyword: value}, {keyword: representation}))
    try:
        read_instance(path)
    except Problem as problem:
        assert (keyword, problem.code) in {  # noqa: PT017 - most of them are accepted
            ("StudyInstanceUID", "malformed"), ("SOPClassUID", "malformed"), ("SOPClassUID", "not_xa"),
            ("SpecificCharacterSet", "malformed"),
        }  # fmt: skip
        return
    for made in results_of(path, tmp_path).values():
        strictly_read(made)
    deidentify_file(path, tmp_path / "copy.dcm", Pseudonyms(b"secret", "patient", "", Dates.KEEP))
    assert strictly_read((tmp_path / "copy.dcm").read_bytes()).PatientIdentityRemoved == "YES"


def test_the_warning_does_not_quote_the_value() -> None:
    assert "PatientName" not in TOLD.sentence
    assert TOLD.sentence.endswith(".")


def test_making_results_writes_no_name_into_a_log(tmp_path: Path) -> None:
    """In a process of its own, because pytest changes the filters of warnings."""
    path = _file(tmp_path, {"PatientName": b"CANARY7", "PatientID": b"CANARY7\\", "PatientSex": b"CANARY7"})
    program = "import sys, pathlib, raw_headers; raw_headers.results_of(*map(pathlib.Path, sys.argv[1:]))"
    made = subprocess.run(
        [sys.executable, "-c", program, path, tmp_path],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    assert "CANARY7" not in made.stdout + made.stderr


@pytest.mark.parametrize("text", ["20240105", "2024.01.05", "2024-1-5", "2024/01/05"])
def test_days(text: str) -> None:
    assert date_text(text) == "20240105"


@pytest.mark.parametrize(
    "text", ["", "2024", "202401", "2024-01/05", "20240230", "00000000", "05.01.2024", "20240105101112"]
)
def test_no_days(text: str) -> None:
    assert date_text(text) == ""


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("10", "10"), ("1011", "1011"), ("101160", "101160"), ("9:05:01.5", "090501.5"), ("24", ""), ("1060", ""),
        ("10:11:12Z", ""), ("1011.5", ""), ("", ""),
    ],
)  # fmt: skip
def test_times_of_day(text: str, read: str) -> None:
    assert time_text(text) == read


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("2024", "2024"), ("202401", "202401"), ("202413", ""), ("20240105", "20240105"), ("2024010510", "2024010510"),
        ("20240105101112.5+0200", "20240105101112.5+0200"), ("2024-01-05T10:11:12Z", "20240105101112+0000"),
        ("2024-01-05 10:11:12.5+02:00", "20240105101112.5+0200"), ("2024.01.0510:11", "202401051011"),
        ("20240105101112+9900", "20240105101112"), ("20240105+0100", "20240105+0100"), ("2024-0500", "2024-0500"),
        ("20241399030405", ""), ("yesterday", ""),
    ],
)  # fmt: skip
def test_dates_with_times(text: str, read: str) -> None:
    assert date_time_text(text) == read


def test_a_copy_keeps_its_facts_and_its_dates(tmp_path: Path) -> None:
    values: dict[str, bytes | None] = {
        "StudyDate": b"2026.03.01", "StudyTime": b"10:11:12", "SpecificCharacterSet": b"ISO_IR 6",
        "Manufacturer": b"Gr\xfcn", "ImagerPixelSpacing": b"0.30000000000000004\\0.3", "InstanceNumber": b"1.0",
    }  # fmt: skip
    path, target = _file(tmp_path, values), tmp_path / "copy.dcm"
    deidentify_file(path, target, Pseudonyms(b"secret", "patient", "", Dates.KEEP))
    copied = strictly_read(target.read_bytes())
    assert (copied.StudyDate, copied.StudyTime, copied.InstanceNumber) == ("20260301", "101112", 1)
    assert copied.Manufacturer == "Grün"
    assert read_instance(target).pixel_spacing_mm == pytest.approx((0.3, 0.3))


# --- every header that the door accepts -------------------------------------------------------------------------------

_TERMS = st.sampled_from([
    b"", b"ISO_IR 6", b"ISO_IR 100", b"ISO_IR 192", b"ISO IR 192", b"ISO_IR 149", b"ISO_IR 13", b"GB18030", b"GBK",
    b"\\ISO 2022 IR 87", b"ISO 2022 IR 6\\ISO 2022 IR 13", b"\\ISO 2022 IR 149", b"\\ISO 2022 IR 58", b"NONE", b"\\", b"iso8859",
])  # fmt: skip
_VALUES = st.one_of(
    st.none(),
    st.binary(max_size=80),
    st.text(max_size=40).map(lambda text: text.encode("utf-8", "replace")),
    st.sampled_from([
        YAMADA, SPRING, b"M\xdcLLER", b"?", b"10:11:12", b"2024.01.05", b"2024-01-05", b"45", b"X" * 70, b"A\\B", b"1.5",
        b"1.02", b" 1.2.3 ", b"A^B^C^D^E^F", b"nan", b"1e400", b"\x1b$B", b"0" * 80, b"m", b"YES ", b"+0100", b"+99",
    ]),
)  # fmt: skip
_KEYWORDS = st.sampled_from([
    *PATIENT_AND_STUDY, "PatientAge", "PatientWeight", "OtherPatientIDs", "IssuerOfPatientID", "StudyDescription",
    "PatientComments", "EthnicGroup", "InstanceNumber", "SeriesNumber", "SeriesDescription", "SeriesDate", "SeriesTime",
    "ContentDate", "AcquisitionDateTime", "AcquisitionTime", "TimezoneOffsetFromUTC", "Manufacturer", "SoftwareVersions",
    "ImageType", "LossyImageCompression", "PatientIdentityRemoved", "DeidentificationMethod", "BodyPartExamined", "KVP",
    "ImageComments", "InstanceCreatorUID", "DeviceSerialNumber", "PositionerMotion", "AcquisitionNumber",
    "DeidentificationMethodCodeSequence", "LongitudinalTemporalInformationModified", "OtherPatientIDsSequence",
])  # fmt: skip
_HEADERS = st.dictionaries(_KEYWORDS, _VALUES, max_size=12)
_REPRESENTATIONS = st.dictionaries(
    st.one_of(_KEYWORDS, st.just("SpecificCharacterSet")),
    st.sampled_from(["LO", "UT", "PN", "DS", "IS", "UI", "US", "FD", "AT", "SQ", "OB", "OW", "UN"]),
    max_size=6,
)


@settings(max_examples=25, deadline=None)  # a report takes half a second
@given(
    terms=st.one_of(st.none(), _TERMS), values=_HEADERS, representations=_REPRESENTATIONS, dates=st.sampled_from(Dates)
)
def test_results_of_every_header_that_the_door_accepts(
    terms: bytes | None, values: dict[str, bytes | None], representations: dict[str, str], dates: Dates
) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / "run.dcm"
        path.write_bytes(with_raw_values(_run(), {**values, "SpecificCharacterSet": terms}, representations))
        try:
            facts = read_instance(path)
        except Problem:
            assume(False)
        for made in results_of(path, folder).values():
            # A wrong UID stays, because the results must join the study of the run.
            found = strictly_read(made, with_uids=UID(facts.study_instance_uid).is_valid)
            assert found.StudyInstanceUID == facts.study_instance_uid
            assert all(keyword in found for keyword in PATIENT_AND_STUDY)
        copy = folder / "copy.dcm"
        deidentify_file(path, copy, Pseudonyms(b"secret", "patient", "", dates))
        for content in (copy.read_bytes(), *results_of(copy, folder).values()):
            assert strictly_read(content).PatientIdentityRemoved == "YES"
        assert read_instance(copy).frames == facts.frames
