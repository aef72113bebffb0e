"""De-identification of runs: no mark of the patient survives, and the geometry does."""

from __future__ import annotations

import csv
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from pydicom.datadict import dictionary_description, dictionary_has_tag, dictionary_VR
from pydicom.dataset import Dataset
from pydicom.tag import Tag
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    RLELossless,
)

from fluoromap_service.dicom import InstanceFacts, open_frames, read_instance
from fluoromap_service.dicom.deidentification import profile
from fluoromap_service.dicom.deidentification.dataset import deidentify
from fluoromap_service.dicom.deidentification.profile import Action, action_for, basic_profile
from fluoromap_service.dicom.deidentification.pseudonyms import Dates, Pseudonyms
from fluoromap_service.dicom.deidentification.run_file import deidentify_file

MakeXa = Callable[..., Path]
FRAMES = np.arange(3 * 8 * 16, dtype=np.uint16).reshape(3, 8, 16)
MARK = "CANARY7"
TEXTS = ("LO", "SH", "ST", "LT", "UT", "UC", "PN", "CS", "AE")
GEOMETRY = {
    "PositionerPrimaryAngle": "31.30", "PositionerSecondaryAngle": "-2", "DistanceSourceToDetector": "1000",
    "DistanceSourceToPatient": "720", "ImagerPixelSpacing": [0.3, 0.3], "PatientOrientation": ["L", "F"],
    "FrameTime": "66.6",
}  # fmt: skip


def pseudonyms(dates: Dates = Dates.REMOVE, subject: str = "", secret: bytes = b"secret") -> Pseudonyms:
    return Pseudonyms(secret, "patient", subject, dates)


def marked() -> Dataset:
    """Return a data set with the mark in every text that the profile names."""
    dataset = Dataset()
    for number, action in basic_profile().items():
        tag = Tag(number)
        try:
            representation = dictionary_VR(tag)
        except KeyError:
            representation = "LO"  # newer than the dictionary of pydicom
        if representation in TEXTS and action is not Action.NEW_UID:
            dataset.add_new(tag, representation, MARK)
        elif representation == "SQ":
            inner = Dataset()
            inner.PatientName, inner.InstitutionName, inner.OperatorsName = MARK, MARK, MARK
            dataset.add_new(tag, "SQ", [inner])
    block = dataset.private_block(0x0029, f"{MARK} CREATOR", create=True)
    block.add_new(1, "LO", MARK)
    dataset.add_new(0x50003000, "OW", MARK.encode())
    dataset.add_new(0x60003000, "OW", MARK.encode())
    dataset.add_new(0x60004000, "LT", MARK)
    dataset.ResponsiblePersonRole = "PARENT"
    dataset.ConsultingPhysicianName = MARK
    dataset.TextValue = MARK
    dataset.ContributingEquipmentSequence = [Dataset()]
    dataset.ContributingEquipmentSequence[0].InstitutionName = MARK
    dataset.ContributingEquipmentSequence[0].OperatorIdentificationSequence = [Dataset()]
    dataset.ContributingEquipmentSequence[0].OperatorIdentificationSequence[0].PersonAddress = MARK
    return dataset


def test_names_of_the_table_are_those_of_the_dictionary() -> None:
    """A row that slipped would have the name of another attribute. The dictionary of pydicom lacks the newest rows."""
    text = files(profile.__package__).joinpath("basic_profile.csv").read_text()
    names = {int(row["tag"], 16): row["name"] for row in csv.DictReader(text.splitlines())}
    known = {tag: dictionary_description(tag) for tag in names if dictionary_has_tag(tag)}
    assert len(known) > 600
    assert {tag: _letters(names[tag]) for tag in known} == {tag: _letters(name) for tag, name in known.items()}


def _letters(name: str) -> str:
    """Return a name without capitals and spaces, in which editions of the standard differ."""
    return name.casefold().replace(" ", "")


@pytest.mark.parametrize("dates", Dates)
def test_no_mark_survives(dates: Dates) -> None:
    dataset = marked()
    assert MARK in str(dataset)
    deidentify(dataset, pseudonyms(dates))
    left = [element.name for element in dataset.iterall() if MARK in str(element.value)]
    assert left == []
    assert not any(element.tag.is_private for element in dataset.iterall())
    assert dataset.PatientIdentityRemoved == "YES"
    assert "burned-in text stays" in dataset.DeidentificationMethod


def test_table_is_that_of_the_standard() -> None:
    """Some rows of PS3.15 table E.1-1, and the count of its rows of single attributes."""
    assert len(basic_profile()) == 653
    expected = {
        "PatientName": Action.EMPTY, "PatientBirthDate": Action.EMPTY, "PatientAge": Action.REMOVE,
        "StudyInstanceUID": Action.NEW_UID, "InstitutionName": Action.DUMMY, "OtherPatientIDs": Action.REMOVE,
        "AccessionNumber": Action.EMPTY, "SourceImageSequence": Action.CLEAN_INSIDE, "Rows": None,
    }  # fmt: skip
    assert {keyword: action_for(Tag(keyword)) for keyword in expected} == expected


def test_uids_are_replaced_everywhere_alike() -> None:
    dataset = Dataset()
    dataset.SOPClassUID = "1.2.840.10008.5.1.4.1.1.12.1"
    dataset.StudyInstanceUID, dataset.SOPInstanceUID = "1.2.3", "1.2.4"
    dataset.SourceImageSequence = [Dataset()]
    dataset.SourceImageSequence[0].ReferencedSOPInstanceUID = "1.2.4"
    dataset.SourceImageSequence[0].ReferencedSOPClassUID = "1.2.840.10008.5.1.4.1.1.12.1"
    replaced = deidentify(dataset, pseudonyms())
    assert set(replaced) == {"1.2.3", "1.2.4"}
    assert dataset.SOPInstanceUID == dataset.SourceImageSequence[0].ReferencedSOPInstanceUID == replaced["1.2.4"]
    assert dataset.SOPInstanceUID.is_valid
    assert dataset.SOPClassUID == "1.2.840.10008.5.1.4.1.1.12.1"
    assert pseudonyms(secret=b"other").uid("1.2.4") != replaced["1.2.4"]


@pytest.mark.parametrize(
    ("dates", "study", "acquired", "time", "modified"),
    [
        (Dates.REMOVE, "", "19000101000000", "", "REMOVED"),
        (Dates.KEEP, "20260301", "20260301093000.5+0100", "093000", "UNMODIFIED"),
        (Dates.SHIFT, None, None, "093000", "MODIFIED"),
    ],
)
def test_dates(dates: Dates, study: str | None, acquired: str | None, time: str, modified: str) -> None:
    dataset = Dataset()
    dataset.StudyDate, dataset.StudyTime, dataset.AcquisitionDateTime = "20260301", "093000", "20260301093000.5+0100"
    dataset.PatientBirthDate, dataset.PatientBirthTime = "19520317", "101500"
    chosen = pseudonyms(dates)
    deidentify(dataset, chosen)
    if dates is Dates.SHIFT:
        assert -3650 <= chosen.shift_days <= -1
        assert dataset.StudyDate != "20260301"
        study, acquired = chosen.moved("20260301"), chosen.moved("20260301093000.5+0100")
        assert acquired.startswith(study)
    assert (dataset.StudyDate or "", dataset.AcquisitionDateTime, dataset.StudyTime or "") == (study, acquired, time)
    assert not dataset.PatientBirthDate
    assert "PatientBirthTime" not in dataset
    assert dataset.LongitudinalTemporalInformationModified == modified


def test_the_subject_is_always_the_same() -> None:
    assert pseudonyms().name == pseudonyms().name
    assert pseudonyms().name.startswith("SUBJECT-")
    assert pseudonyms(secret=b"other").name != pseudonyms().name
    dataset = Dataset()
    deidentify(dataset, pseudonyms(subject="S-001"))
    assert (dataset.PatientName, dataset.PatientID) == ("S-001^", "S-001")


def _same_but_for_uids(found: InstanceFacts, expected: InstanceFacts) -> bool:
    apart = {"sop_instance_uid", "study_instance_uid", "series_instance_uid", "acquired", "transfer_syntax"}
    pair = found.to_json(), expected.to_json()
    return all(pair[0][name] == pair[1][name] for name in pair[0] if name not in apart)


@pytest.mark.parametrize(
    "syntax",
    [ExplicitVRLittleEndian, ImplicitVRLittleEndian, ExplicitVRBigEndian, DeflatedExplicitVRLittleEndian, RLELossless],
)
def test_copies_of_files(make_xa: MakeXa, tmp_path: Path, syntax: str) -> None:
    if syntax == RLELossless:
        source = make_xa(FRAMES, **GEOMETRY)
        dataset = pydicom.dcmread(source)
        dataset.compress(RLELossless)
        dataset.save_as(source)
    else:
        source = make_xa(FRAMES, syntax=syntax, **GEOMETRY)
    target = tmp_path / "copy.dcm"
    replaced = deidentify_file(source, target, pseudonyms())
    expected, found = read_instance(source), read_instance(target)
    assert _same_but_for_uids(found, expected)
    assert found.sop_instance_uid == replaced[expected.sop_instance_uid]
    pixels = [open_frames(path, facts)[2] for path, facts in ((source, expected), (target, found))]
    assert np.array_equal(*pixels)
    content = target.read_bytes()
    assert b"SECRET" not in content
    assert expected.sop_instance_uid.encode() not in content


def test_only_the_numbers_of_ge_s_table_stay(make_xa: MakeXa, tmp_path: Path) -> None:
    source = make_xa(FRAMES, **GEOMETRY)
    dataset = pydicom.dcmread(source)
    block = dataset.private_block(0x0019, "DLX_SERIE_01", create=True)
    for element, value in ((0x21, "84"), (0x22, "503.9"), (0x23, "9.2"), (0x30, MARK)):
        block.add_new(element, "LO" if value == MARK else "DS", value)
    dataset.save_as(source)
    target = tmp_path / "copy.dcm"
    deidentify_file(source, target, pseudonyms())
    assert read_instance(target).table_mm == read_instance(source).table_mm == (9.2, 84.0, 503.9)
    assert MARK.encode() not in target.read_bytes()
    copied = pydicom.dcmread(target)
    assert [item.CodeValue for item in copied.DeidentificationMethodCodeSequence] == ["113100", "113111"]
    dataset[block.get_tag(0x21)].value = "1"
    dataset[block.get_tag(0x22)] = dataset.data_element("PatientName").__class__(block.get_tag(0x22), "LO", MARK)
    dataset.save_as(source)
    deidentify_file(source, target, pseudonyms())
    assert MARK.encode() not in target.read_bytes()


def test_a_truncated_file_is_refused(make_xa: MakeXa, tmp_path: Path) -> None:
    source = make_xa(FRAMES, **GEOMETRY)
    source.write_bytes(source.read_bytes()[:-10])
    with pytest.raises(Exception, match="ends before"):
        deidentify_file(source, tmp_path / "copy.dcm", pseudonyms())


def test_attributes_after_the_pixels_are_left_out(make_xa: MakeXa, tmp_path: Path) -> None:
    source = make_xa(FRAMES, **GEOMETRY)
    dataset = pydicom.dcmread(source)
    dataset.DataSetTrailingPadding = MARK.encode()
    dataset.save_as(source)
    deidentify_file(source, tmp_path / "copy.dcm", pseudonyms())
    assert MARK.encode() not in (tmp_path / "copy.dcm").read_bytes()


@pytest.mark.parametrize("keyword", ["StudyDate", "FrameTime"])
def test_damaged_values_are_removed_or_left_without_the_mark(make_xa: MakeXa, tmp_path: Path, keyword: str) -> None:
    attributes: dict[str, Any] = GEOMETRY | {keyword: "20260301" if keyword == "StudyDate" else "66.66667"}
    source = make_xa(FRAMES, **attributes)
    content = source.read_bytes()
    old = str(attributes[keyword]).encode()
    source.write_bytes(content.replace(old, MARK.encode() + b" " * (len(old) - len(MARK))))
    deidentify_file(source, tmp_path / "copy.dcm", pseudonyms(Dates.SHIFT))
    assert MARK.encode() not in (tmp_path / "copy.dcm").read_bytes()
