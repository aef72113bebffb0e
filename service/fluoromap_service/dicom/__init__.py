"""X-ray runs as DICOM: checked reading, frames decoded one at a time, and writing."""

import warnings

from fluoromap_service.dicom.errors import DicomCode, dicom_problem
from fluoromap_service.dicom.facts import HeaderWarning, InstanceFacts
from fluoromap_service.dicom.frames import DicomFrames, frame_to_8bit, open_frames
from fluoromap_service.dicom.orientation import image_axes_from_orientation
from fluoromap_service.dicom.reading import read_instance
from fluoromap_service.dicom.writing import deterministic_uid, write_cine

# These quote header values, which may name a patient, to standard error; what matters of them is a HeaderWarning.
warnings.filterwarnings("ignore", module=r"pydicom\.")

__all__ = [
    "DicomCode",
    "DicomFrames",
    "HeaderWarning",
    "InstanceFacts",
    "deterministic_uid",
    "dicom_problem",
    "frame_to_8bit",
    "image_axes_from_orientation",
    "open_frames",
    "read_instance",
    "write_cine",
]
