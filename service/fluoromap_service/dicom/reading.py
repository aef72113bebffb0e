"""Read one DICOM file into the facts of a run, with all checks."""

from __future__ import annotations

from io import BufferedReader
from pathlib import Path

from pydicom.uid import (
    UID,
    EnhancedXAImageStorage,
    EnhancedXRFImageStorage,
    MultiFrameGrayscaleByteSecondaryCaptureImageStorage,
    MultiFrameGrayscaleWordSecondaryCaptureImageStorage,
    SecondaryCaptureImageStorage,
    XRayAngiographicImageStorage,
    XRayRadiofluoroscopicImageStorage,
)

from fluoromap_service.dicom.errors import DicomCode, dicom_problem
from fluoromap_service.dicom.facts import SIMULATED_EQUIPMENT, HeaderWarning, InstanceFacts, Plane, is_uid
from fluoromap_service.dicom.frames import read_frame
from fluoromap_service.dicom.header import Header, read_file_meta, read_header, representation_problem
from fluoromap_service.dicom.image import pixel_facts, r_wave_frames, window
from fluoromap_service.dicom.inflation import open_dicom
from fluoromap_service.dicom.pixel_layout import PixelLayout, pixel_layout
from fluoromap_service.dicom.positioner import (
    gantry_facts,
    image_axes,
    orientation_letters,
    table_position,
    warn_of_motion,
)
from fluoromap_service.dicom.timing import acquisition_start, frame_times_ms
from fluoromap_service.problem import Problem

PROJECTIONS = frozenset(
    {
        XRayAngiographicImageStorage,
        XRayRadiofluoroscopicImageStorage,
        EnhancedXAImageStorage,
        EnhancedXRFImageStorage,
    }
)
"""SOP classes of X-ray runs."""
CAPTURES = frozenset(
    {
        SecondaryCaptureImageStorage,
        MultiFrameGrayscaleByteSecondaryCaptureImageStorage,
        MultiFrameGrayscaleWordSecondaryCaptureImageStorage,
    }
)
"""SOP classes of copies of runs, as archives and workstations save them; the modality is still XA or RF."""


def read_instance(path: Path) -> InstanceFacts:
    """Read and check one file.

    The function finds every fault that does not need all frames decoded. It decodes the first frame. Memory does not grow
    with the file.

    Raises
    ------
    Problem
        With any code of :class:`DicomCode`.
    OSError
        When the file cannot be opened.
    """
    with open_dicom(path) as file:
        header = read_header(file)
        if header.unknown_representation is not None:
            # Stored, it would break every reader of the whole header.
            raise representation_problem(header.unknown_representation)
        _check_kind(header)
        warnings: list[HeaderWarning] = []
        layout = pixel_layout(file, header, warnings)
        bits_used = _bits_used(file, layout)
    if bits_used > layout.bits_stored:
        warnings.append(HeaderWarning.BITS_STORED_EXCEEDED)
    return _facts(header, layout, max(bits_used, layout.bits_stored), warnings)


def read_instance_uids(path: Path) -> tuple[str | None, str | None]:
    """Return SOP Class UID and SOP Instance UID of any DICOM file.

    :func:`read_instance` may refuse the file. Where the data set is damaged, those of the file meta information count.
    None for a UID that cannot be read.

    Raises
    ------
    Problem
        As :func:`fluoromap_service.dicom.header.read_header`, when nothing can be read.
    """
    keywords = ("SOPClassUID", "SOPInstanceUID")
    try:
        with open_dicom(path) as file:
            header = read_header(file)
        uids = [header.text(keyword) for keyword in keywords]
    except Problem:
        with path.open("rb") as file:
            meta = read_file_meta(file)
        uids = [meta.sop_class_uid, meta.sop_instance_uid]
    sop_class_uid, sop_instance_uid = (uid if is_uid(uid) else None for uid in uids)
    return sop_class_uid, sop_instance_uid


def _check_kind(header: Header) -> None:
    kind, modality = header.text("SOPClassUID"), header.text("Modality")
    if kind in PROJECTIONS or (kind in CAPTURES and modality in ("XA", "RF")):
        return
    if not kind:
        raise _lacks("SOPClassUID")
    name = UID(kind).name if is_uid(kind) else "of an invalid class"
    raise dicom_problem(
        DicomCode.NOT_XA,
        f"This object ({name}) is no X-ray angiographic (XA) or radiofluoroscopic (RF) run; send XA or RF.",
        "SOPClassUID",
    )


def _lacks(keyword: str) -> Problem:
    return dicom_problem(DicomCode.MALFORMED, f"{keyword} is missing or invalid; export the run again.", keyword)


def _bits_used(file: BufferedReader, layout: PixelLayout) -> int:
    return int(read_frame(file, layout, 0).max()).bit_length()


def _facts(header: Header, layout: PixelLayout, bits_stored: int, warnings: list[HeaderWarning]) -> InstanceFacts:
    rows, columns, frames = layout.rows, layout.columns, layout.frames
    times = frame_times_ms(header, frames, warnings)
    gantry = gantry_facts(header, rows, columns, warnings)
    axes = image_axes(header, gantry, warnings)
    warn_of_motion(header, warnings)
    table_mm, table_origin = table_position(header)
    pixels = pixel_facts(header, rows, columns, bits_stored, warnings)
    start = acquisition_start(header)
    shown = window(header, bits_stored, warnings)
    waves = r_wave_frames(header, frames, warnings)
    if header.names_need_repair:
        warnings.append(HeaderWarning.PATIENT_OR_STUDY_REPAIRED)
    return InstanceFacts(
        sop_class_uid=_uid(header, "SOPClassUID"),
        sop_instance_uid=_uid(header, "SOPInstanceUID"),
        study_instance_uid=_uid(header, "StudyInstanceUID"),
        series_instance_uid=_uid(header, "SeriesInstanceUID"),
        series_number=header.integer("SeriesNumber"),
        frames=frames,
        rows=rows,
        columns=columns,
        transfer_syntax=layout.transfer_syntax,
        frame_times_ms=times,
        frame_time_ms=times[-1] / (frames - 1) if frames > 1 else 0.0,
        acquired=None if start is None else start.earliest,
        plane=_plane(header),
        primary_deg=gantry.primary_deg,
        secondary_deg=gantry.secondary_deg,
        source_detector_mm=gantry.source_detector_mm,
        source_isocentre_mm=gantry.source_isocentre_mm,
        pixel_spacing_mm=gantry.pixel_spacing_mm,
        image_axes=axes,
        patient_orientation=orientation_letters(header),
        table_mm=table_mm,
        pixels=pixels,
        window=shown,
        r_wave_frames=waves,
        missing=gantry.missing,
        warnings=tuple(dict.fromkeys(warnings)),
        table_origin=table_origin,
        simulated=_is_simulated(header),
        acquired_within_s=0.0 if start is None else start.within_s,
        acquired_zone_known=start is not None and start.zone_known,
    )


def _uid(header: Header, keyword: str) -> str:
    value = header.text(keyword)
    if not is_uid(value):
        raise _lacks(keyword)
    return value


def _is_simulated(header: Header) -> bool:
    """Return True for a run of the equipment that :func:`fluoromap_service.dicom.writing.write_cine` names."""
    return (header.text("Manufacturer"), header.text("ManufacturerModelName")) == SIMULATED_EQUIPMENT


def _plane(header: Header) -> Plane:
    """Return the plane of a biplane system.

    ImageType (0008,0008) value 3 of legacy XA, PS3.3 C.8.7.1.1.1; PlaneIdentification (0018,9457) of Enhanced XA.
    """
    image_type = header.texts("ImageType")
    names = {*image_type[2:3], header.text("PlaneIdentification")}
    if names & {"BIPLANE A", "PLANE A"}:
        return "A"
    return "B" if names & {"BIPLANE B", "PLANE B"} else "single"
