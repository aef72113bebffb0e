"""X-ray runs as DICOM: reading with checks, decoding frame by frame, and writing."""

import warnings

from fluoromap_service.dicom.errors import DicomCode, dicom_problem
from fluoromap_service.dicom.facts import HeaderWarning, InstanceFacts
from fluoromap_service.dicom.frames import DicomFrames, cine_8bit, frame_png, frame_to_8bit, open_frames
from fluoromap_service.dicom.orientation import image_axes_from_orientation
from fluoromap_service.dicom.reading import read_instance
from fluoromap_service.dicom.writing import deterministic_uid, write_cine

# pydicom's warnings quote header values, which may name a patient. A HeaderWarning says what matters.
warnings.filterwarnings("ignore", module=r"pydicom\.")

__all__ = [
    "DicomCode",
    "DicomFrames",
    "HeaderWarning",
    "InstanceFacts",
    "cine_8bit",
    "deterministic_uid",
    "dicom_problem",
    "frame_png",
    "frame_to_8bit",
    "image_axes_from_orientation",
    "open_frames",
    "read_instance",
    "write_cine",
]
