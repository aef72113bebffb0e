"""The DICOM objects of a job as a delivery sends them."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass

import pydicom

from fluoromap_service.api.results.result_objects import objects_zip


@dataclass(frozen=True, slots=True)
class OutgoingObject:
    """A DICOM file with the UIDs by which a peer knows it."""

    name: str
    content: bytes
    sop_class_uid: str
    study_instance_uid: str
    series_instance_uid: str
    sop_instance_uid: str

    @classmethod
    def of_file(cls, name: str, content: bytes) -> OutgoingObject:
        """Read the UIDs of a DICOM file."""
        keywords = ["SOPClassUID", "StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID"]
        header = pydicom.dcmread(io.BytesIO(content), stop_before_pixels=True, specific_tags=list(keywords))
        return cls(name, content, *(str(header[keyword].value) for keyword in keywords))


def delivery_objects(job_id: str) -> list[OutgoingObject]:
    """Return the DICOM objects of a job in the order of sending.

    Raises
    ------
    Problem
        As ``objects_zip``.
    """
    with zipfile.ZipFile(io.BytesIO(objects_zip(job_id).path.read_bytes())) as archive:
        return [OutgoingObject.of_file(name, archive.read(name)) for name in archive.namelist()]
