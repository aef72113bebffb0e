"""Write a run as a multi-frame X-Ray Angiographic Image, frame by frame."""

from __future__ import annotations

import struct
import uuid
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.filewriter import dcmwrite
from pydicom.uid import UID, ExplicitVRLittleEndian, XRayAngiographicImageStorage
from pydicom.valuerep import DSfloat

from fluoromap.geometry import Gantry
from fluoromap_service.dicom.facts import SIMULATED_EQUIPMENT, Plane
from fluoromap_service.dicom.orientation import field_of_view_of, patient_orientation

_PLANES: dict[Plane, str] = {"single": "SINGLE PLANE", "A": "BIPLANE A", "B": "BIPLANE B"}
_UNDEFINED_LENGTH = 0xFFFFFFFF


def deterministic_uid(*names: str) -> str:
    """Return a UID that depends on the names only.

    It is under the root 2.25 (PS3.5 annex B.2: a UUID as one number).
    """
    return f"2.25.{uuid.uuid5(uuid.NAMESPACE_URL, '/'.join(('urn:fluoromap', *names))).int}"


def write_cine(
    path: Path,
    frames: Iterable[NDArray[np.uint16]],
    *,
    frame_count: int,
    gantry: Gantry,
    frame_time_ms: float,
    acquired: datetime,
    study_instance_uid: str,
    series_number: int,
    sop_instance_uid: str,
    series_instance_uid: str | None = None,
    bits_stored: int = 12,
    plane: Plane = "single",
    r_wave_frames: tuple[int, ...] = (),
) -> None:
    """Write a simulated cine run; memory does not grow with the number of frames.

    The object is a complete X-Ray Angiographic Image (PS3.3 A.14), Explicit VR Little Endian, with linear intensities and
    a patient named SIMULATED^PHANTOM. The file gets its name when it is whole.

    Parameters
    ----------
    path : Path
    frames : iterable of (rows, columns) uint16 arrays
        Stored pixels, each below ``2**bits_stored``.
    frame_count : int
        Number of frames; the header comes before the first frame.
    gantry : Gantry
        Gives Rows, Columns, PatientOrientation and all positioner attributes.
    frame_time_ms : float
    acquired : datetime
        Start of the run; with a time zone.
    study_instance_uid, sop_instance_uid : str
    series_number : int
    series_instance_uid : str, optional
        By default a UID of the study's UID and the series number.
    bits_stored : int
        9 to 16.
    plane : {"single", "A", "B"}
    r_wave_frames : tuple of int
        Frames of R waves, from 0.

    Raises
    ------
    ValueError
        When a frame, or the number of frames, differs from the announced one.
    """
    frame_bytes = gantry.rows * gantry.columns * 2
    if frame_count < 1 or frame_count * frame_bytes >= _UNDEFINED_LENGTH:
        raise ValueError("a native DICOM file holds 1 or more frames and less than 4 GiB of pixels")
    if not 9 <= bits_stored <= 16 or not frame_time_ms > 0 or acquired.utcoffset() is None:
        raise ValueError("bits_stored lies within 9..16, frame_time_ms is positive and acquired has a time zone")
    dataset = _image_module(gantry, frame_count, frame_time_ms, bits_stored, plane, r_wave_frames)
    _identify(
        dataset,
        acquired.astimezone(UTC),
        study_instance_uid,
        series_instance_uid or deterministic_uid(study_instance_uid, "series", str(series_number)),
        series_number,
        sop_instance_uid,
    )
    _positioner(dataset, gantry)
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian

    partial = path.with_name(f"{path.name}.part")
    try:
        with partial.open("wb") as file:
            dcmwrite(file, dataset, enforce_file_format=True)
            file.write(struct.pack("<HH2sHL", 0x7FE0, 0x0010, b"OW", 0, frame_count * frame_bytes))
            written = 0
            for frame in frames:
                if frame.shape != (gantry.rows, gantry.columns) or frame.dtype != np.uint16:
                    raise ValueError("each frame must be a uint16 array of the gantry's rows and columns")
                if int(frame.max()) >> bits_stored:
                    raise ValueError(f"a frame has pixels of more than {bits_stored} bits")
                written += 1
                if written > frame_count:
                    break
                file.write(np.ascontiguousarray(frame, dtype="<u2").data)
        if written != frame_count:
            raise ValueError(f"{frame_count} frames are announced, but there are fewer or more")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _identify(
    dataset: Dataset, acquired: datetime, study_uid: str, series_uid: str, series_number: int, sop_uid: str
) -> None:
    """Set the patient, study, series, equipment and SOP common modules."""
    date, time = acquired.strftime("%Y%m%d"), acquired.strftime("%H%M%S.%f")
    dataset.SpecificCharacterSet = "ISO_IR 192"
    dataset.SOPClassUID = XRayAngiographicImageStorage
    dataset.SOPInstanceUID = UID(sop_uid)
    dataset.PatientName = "SIMULATED^PHANTOM"
    dataset.PatientID = "SIMULATED"
    dataset.PatientBirthDate = ""
    dataset.PatientSex = "O"
    dataset.StudyInstanceUID = UID(study_uid)
    dataset.StudyDate, dataset.StudyTime, dataset.StudyID = date, time, "1"
    dataset.StudyDescription = "Simulated electrophysiology study"
    dataset.AccessionNumber = ""
    dataset.ReferringPhysicianName = ""
    dataset.Modality = "XA"
    dataset.SeriesInstanceUID = UID(series_uid)
    dataset.SeriesNumber = series_number
    dataset.SeriesDate, dataset.SeriesTime = date, time
    dataset.BodyPartExamined = "HEART"
    dataset.PatientPosition = "HFS"
    dataset.Manufacturer, dataset.ManufacturerModelName = SIMULATED_EQUIPMENT
    dataset.SoftwareVersions = "simulation"
    dataset.InstanceNumber = 1
    dataset.ContentDate, dataset.ContentTime = date, time
    dataset.AcquisitionDate, dataset.AcquisitionTime = date, time
    dataset.AcquisitionDateTime = f"{date}{time}+0000"
    dataset.TimezoneOffsetFromUTC = "+0000"


def _image_module(
    gantry: Gantry, frames: int, frame_time_ms: float, bits_stored: int, plane: Plane, r_wave_frames: tuple[int, ...]
) -> Dataset:
    """Return the pixel, multi-frame, cine, X-ray image and acquisition modules.

    PS3.3 C.7.6.3 to C.7.6.6, C.8.7.1, C.8.7.2.
    """
    dataset = Dataset()
    dataset.ImageType = ["ORIGINAL", "PRIMARY", _PLANES[plane]]
    dataset.SamplesPerPixel = 1
    dataset.PhotometricInterpretation = "MONOCHROME2"
    dataset.Rows, dataset.Columns = gantry.rows, gantry.columns
    dataset.BitsAllocated = 16
    dataset.BitsStored = bits_stored
    dataset.HighBit = bits_stored - 1
    dataset.PixelRepresentation = 0
    dataset.PixelIntensityRelationship = "LIN"
    dataset.BurnedInAnnotation = "NO"
    dataset.LossyImageCompression = "00"
    dataset.NumberOfFrames = frames
    dataset.FrameIncrementPointer = 0x00181063
    dataset.FrameTime = _decimal(frame_time_ms)
    dataset.CineRate = max(1, round(1000 / frame_time_ms))
    if r_wave_frames:
        dataset.RWavePointer = [frame + 1 for frame in r_wave_frames]
    dataset.KVP = None
    dataset.RadiationSetting = "GR"
    dataset.XRayTubeCurrent = None
    dataset.ExposureTime = None
    dataset.Exposure = None
    return dataset


def _positioner(dataset: Dataset, gantry: Gantry) -> None:
    """Set the XA positioner and table modules and the field of view (PS3.3 C.8.7.5, C.8.7.6, C.8.11.4)."""
    rotation, flipped = field_of_view_of(gantry.image_axes)
    dataset.PatientOrientation = list(patient_orientation(gantry.primary_deg, gantry.secondary_deg, gantry.image_axes))
    dataset.PositionerMotion = "STATIC"
    dataset.PositionerPrimaryAngle = _decimal(gantry.primary_deg)
    dataset.PositionerSecondaryAngle = _decimal(gantry.secondary_deg)
    dataset.DistanceSourceToDetector = _decimal(gantry.source_detector_mm)
    dataset.DistanceSourceToPatient = _decimal(gantry.source_isocentre_mm)
    dataset.EstimatedRadiographicMagnificationFactor = _decimal(gantry.source_detector_mm / gantry.source_isocentre_mm)
    dataset.ImagerPixelSpacing = [_decimal(spacing) for spacing in gantry.pixel_spacing_mm]
    dataset.FieldOfViewRotation = rotation
    dataset.FieldOfViewHorizontalFlip = "YES" if flipped else "NO"
    dataset.TableMotion = "STATIC"


def _decimal(value: float) -> DSfloat:
    # A decimal string has 16 characters (PS3.5 table 6.2-1).
    return DSfloat(value, auto_format=True)
