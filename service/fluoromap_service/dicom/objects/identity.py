"""The patient, study, series and equipment of a result object, from the header of a source run."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from pathlib import Path

from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.filewriter import dcmwrite
from pydicom.uid import ExplicitVRLittleEndian

from fluoromap_service.dicom.header import read_attributes
from fluoromap_service.dicom.inflation import open_dicom
from fluoromap_service.dicom.repair import PATIENT_AND_STUDY, repair
from fluoromap_service.dicom.writing import deterministic_uid

MANUFACTURER = "fluoromap"
RESEARCH = "Research result, preliminary"
_FUNCTIONAL_GROUPS = 0x5200
"""Group of the functional groups of Enhanced objects; the pixels follow in a higher one."""

_DEIDENTIFICATION = (
    "PatientIdentityRemoved", "DeidentificationMethod", "DeidentificationMethodCodeSequence",
    "LongitudinalTemporalInformationModified",
)  # fmt: skip


def result_uid(job_id: str, *names: str) -> str:
    """Return the UID of a part of the results of a job.

    A part is an object, its series, or an item in it.
    """
    return deterministic_uid("job", job_id, *names)


def source_header(path: Path) -> Dataset:
    """Return the repaired header of a run for its results.

    Private attributes and functional groups are left out.
    Each attribute of the patient and study modules that the run lacks is there and empty (type 2, PS3.5 section 7.4.3).
    """
    with open_dicom(path) as file:
        _, header = read_attributes(file)
    for tag in list(header.keys()):
        if tag.is_private or tag.group >= _FUNCTIONAL_GROUPS:
            del header[tag]
    repair(header)
    for keyword in PATIENT_AND_STUDY:
        if keyword not in header:
            setattr(header, keyword, "")
    return header


@dataclass(frozen=True, eq=False)
class ResultSource:
    """The origin of the result objects of a job.

    job_id : id of the job, from which all UIDs derive. finished : its end, UTC; dates the objects, so that the same job
    always gives the same bytes. headers : of the source runs, without pixels. The first gives patient and study, as
    :func:`source_header` returns it; the others need only their UIDs.
    """

    job_id: str
    finished: datetime
    headers: tuple[Dataset, ...]

    def uid(self, *names: str) -> str:
        """Return the UID of a part of the results."""
        return result_uid(self.job_id, *names)

    @property
    def frame_of_reference(self) -> str:
        """UID of the frame of reference: patient axes (LPS), origin at the reference catheter, if any, else the isocentre."""
        return self.uid("frame of reference")


def set_identity(
    dataset: Dataset, source: ResultSource, sop_class: str, name: str, series_number: int, modality: str
) -> None:
    """Set the modules that all result objects share (PS3.3 C.7.1.1, C.7.2.1, C.7.3.1, C.7.5.1, C.12.1)."""
    for keyword in ("SpecificCharacterSet", *PATIENT_AND_STUDY):
        setattr(dataset, keyword, source.headers[0][keyword].value)
    dataset.SOPClassUID = sop_class
    dataset.SOPInstanceUID = source.uid(name)
    dataset.SeriesInstanceUID = source.uid(name, "series")
    dataset.SeriesNumber = series_number
    dataset.SeriesDescription = RESEARCH
    dataset.InstanceNumber = 1
    dataset.Modality = modality
    dataset.BodyPartExamined = "HEART"
    set_deidentification(dataset, source)
    set_equipment(dataset)
    set_dates(dataset, source)


def set_deidentification(dataset: Dataset, source: ResultSource) -> None:
    """Copy what the source says of its de-identification (PS3.3 C.7.1.1, C.12.1)."""
    for keyword in _DEIDENTIFICATION:
        if keyword in source.headers[0]:
            setattr(dataset, keyword, source.headers[0][keyword].value)


def set_equipment(dataset: Dataset) -> None:
    """Set the enhanced general equipment (PS3.3 C.7.5.2)."""
    dataset.Manufacturer = dataset.ManufacturerModelName = MANUFACTURER
    dataset.DeviceSerialNumber = "0"
    dataset.SoftwareVersions = version("fluoromap")


def set_dates(dataset: Dataset, source: ResultSource) -> None:
    """Set the dates of an object to the end of its job.

    They are in the time zone of the source runs, UTC where the runs state none.
    """
    # The offset counts for the copied study date too; where the runs state none, neither does the object.
    finished, offset = source.finished, source.headers[0].get("TimezoneOffsetFromUTC")
    if offset and re.fullmatch(r"[+-][0-9]{4}", offset):
        finished = finished.astimezone(datetime.strptime(offset, "%z").tzinfo)
        dataset.TimezoneOffsetFromUTC = offset
    date, time = f"{finished:%Y%m%d}", f"{finished:%H%M%S}"
    dataset.ContentDate = dataset.SeriesDate = dataset.InstanceCreationDate = date
    dataset.ContentTime = dataset.SeriesTime = dataset.InstanceCreationTime = time


def reference(header: Dataset) -> Dataset:
    """Return an item that refers to a source run."""
    item = Dataset()
    item.ReferencedSOPClassUID = header.SOPClassUID
    item.ReferencedSOPInstanceUID = header.SOPInstanceUID
    return item


def code(value: str, scheme: str, meaning: str) -> Dataset:
    """Return an item of a code sequence."""
    item = Dataset()
    item.CodeValue, item.CodingSchemeDesignator, item.CodeMeaning = value, scheme, meaning
    return item


def file_bytes(dataset: Dataset) -> bytes:
    """Return an object as a DICOM file, Explicit VR Little Endian."""
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    stream = io.BytesIO()
    dcmwrite(stream, dataset, enforce_file_format=True)
    return stream.getvalue()
