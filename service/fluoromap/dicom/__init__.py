"""X-ray runs as DICOM: checked reading, frames decoded one at a time, and writing."""

import warnings

from fluoromap.dicom.errors import DicomCode, DicomProblem
from fluoromap.dicom.facts import HeaderWarning, InstanceFacts
from fluoromap.dicom.frames import DicomFrames, frame_to_8bit, open_frames
from fluoromap.dicom.orientation import image_axes_from_orientation
from fluoromap.dicom.reading import read_instance
from fluoromap.dicom.writing import deterministic_uid, write_cine

# These quote header values, which may name a patient, to standard error; what matters of them is a HeaderWarning.
warnings.filterwarnings("ignore", module=r"pydicom\.")

__all__ = [
    "DicomCode",
    "DicomFrames",
    "DicomProblem",
    "HeaderWarning",
    "InstanceFacts",
    "deterministic_uid",
    "frame_to_8bit",
    "image_axes_from_orientation",
    "open_frames",
    "read_instance",
    "write_cine",
]
