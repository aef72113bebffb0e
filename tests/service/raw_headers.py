"""Runs whose headers have raw values, as scanners and archives write them, and strict readers of what leaves."""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from PIL import Image
from pydicom import config
from pydicom.datadict import dictionary_VR
from pydicom.dataset import Dataset
from pydicom.filebase import DicomBytesIO
from pydicom.filewriter import write_data_element
from pydicom.tag import BaseTag, Tag

from fluoromap_service.dicom.header import data_set_start
from fluoromap_service.dicom.objects.job_results import (
    ResultOrigin,
    pictures_object,
    report_object,
    surface_object,
)
from fluoromap_service.dicom.objects.pictures import PictureSeries
from fluoromap_service.dicom.objects.report_site import ReportSite

UNUSUAL: dict[str, dict[str, bytes | None]] = {
    "charset_leading_empty_ISO2022IR87": {
        "SpecificCharacterSet": b"\\ISO 2022 IR 87",
        "PatientName": b"Yamada^Tarou=\x1b$B;3ED\x1b(B^\x1b$BB@O:\x1b(B",
    },
    "charset_empty": {"SpecificCharacterSet": b""},
    "charset_ISO_IR_6": {"SpecificCharacterSet": b"ISO_IR 6"},
    "charset_without_underscore": {"SpecificCharacterSet": b"ISO IR 192", "PatientName": "MÜLLER".encode()},
    "no_PatientBirthDate": {"PatientBirthDate": None},
    "PatientSex_question_mark": {"PatientSex": b"?"},
    "StudyTime_with_colons": {"StudyTime": b"10:11:12"},
    "nothing_of_type_2": dict.fromkeys(
        ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "AccessionNumber",
         "ReferringPhysicianName", "StudyID"),
    ),
    "everything_at_once": {
        "SpecificCharacterSet": b"NONE", "PatientName": b"M\xdcLLER\\A^B^C^D^E^F", "PatientID": b"X" * 70,
        "PatientBirthDate": b"1952-03-17", "PatientSex": b"w", "PatientAge": b"old", "StudyDate": b"2024.01.05",
        "StudyTime": b"noon", "AccessionNumber": b"1\\2", "StudyID": b"\x01\x02\x03", "ReferringPhysicianName": b"R" * 80,
        "InstanceNumber": b"1.5", "TimezoneOffsetFromUTC": b"+01:00", "StudyDescription": b"Stra\xdfe" * 20,
        "Manufacturer": b"\x1b$B", "PatientIdentityRemoved": b"maybe", "SeriesDate": b"tomorrow",
    },
}  # fmt: skip
"""Headers that scanners and archives write and that strict readers refuse."""

FINISHED = datetime(2026, 3, 1, 10, 0, tzinfo=UTC)


def with_raw_values(
    content: bytes, values: Mapping[str, bytes | None], representations: Mapping[str, str] | None = None
) -> bytes:
    """Return a DICOM file with these bytes as values of attributes.

    ``representations`` : of attributes that the file gives another one than the dictionary.

    They may break the standard. None removes an attribute. The file is Explicit VR Little Endian, and the attributes have the
    short form of PS3.5 table 7.1-2 or that of table 7.1-1.
    """
    dataset = pydicom.dcmread(io.BytesIO(content))
    written = {tag: _element(dataset, tag) for tag in dataset.keys()}  # noqa: SIM118 - a data set iterates over elements
    for keyword, value in values.items():
        written.pop(Tag(keyword), None)
        if value is not None:
            representation = (representations or {}).get(keyword) or dictionary_VR(keyword)
            written[Tag(keyword)] = _raw_element(keyword, representation, value)
    _, start = data_set_start(BufferedReader(io.BytesIO(content)))  # type: ignore[arg-type]
    return content[:start] + b"".join(written[tag] for tag in sorted(written))


def _element(dataset: Dataset, tag: BaseTag) -> bytes:
    stream = DicomBytesIO()
    stream.is_implicit_VR, stream.is_little_endian = False, True
    write_data_element(stream, dataset[tag])
    return stream.getvalue()


def _raw_element(keyword: str, representation: str, value: bytes) -> bytes:
    tag = Tag(keyword)
    value += (b"\0" if representation == "UI" else b" ") * (len(value) % 2)
    head = struct.pack("<HH2s", tag.group, tag.element, representation.encode())
    long = representation in ("OB", "OD", "OF", "OL", "OV", "OW", "SQ", "SV", "UC", "UN", "UR", "UT", "UV")
    return head + struct.pack("<HL" if long else "<H", *((0, len(value)) if long else (len(value),))) + value


def results_of(run: Path, folder: Path) -> dict[str, bytes]:
    """Return a result object of each kind; the file is the job's first run."""
    origin = ResultOrigin("job", FINISHED, run, ())
    picture, surface = folder / "picture.png", folder / "surface.stl"
    Image.fromarray(np.zeros((8, 16, 3), np.uint8)).save(picture)
    surface.write_bytes(bytes(84))
    return {
        "report": report_object(origin, (ReportSite("Süd-山", (1.0, 2.0, 3.0), 0.5, 41.0),), 1.5),
        "pictures": pictures_object(origin, PictureSeries("map", 9010, "Map", 1, 8, 16), (picture,)),
        "surface": surface_object(origin, surface),
    }


@contextmanager
def strict_pydicom() -> Any:
    """Let pydicom raise for each value that breaks PS3.5 table 6.2-1."""
    before = config.settings.reading_validation_mode
    config.settings.reading_validation_mode = config.RAISE
    try:
        yield
    finally:
        config.settings.reading_validation_mode = before


def strictly_read(content: bytes, *, with_uids: bool = True) -> Dataset:
    """Read a DICOM object with all its values in pydicom's strict mode.

    ``with_uids`` : whether UIDs have to be valid too.
    """
    dataset = pydicom.dcmread(io.BytesIO(content))
    with strict_pydicom():
        _read_values(dataset, with_uids)
    return dataset


def _read_values(dataset: Dataset, with_uids: bool) -> None:
    for tag in list(dataset.keys()):
        if dataset.get_item(tag).VR == "UI" and not with_uids:
            continue
        if dataset[tag].VR == "SQ":
            for item in dataset[tag].value:
                _read_values(item, with_uids)
