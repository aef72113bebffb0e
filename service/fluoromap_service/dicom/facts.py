"""The facts of one DICOM instance: a run's geometry, timing and pixels, without patient data."""

from __future__ import annotations

import dataclasses
import itertools
import re
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any, Literal

from fluoromap.contracts import PixelFacts, Shutter
from fluoromap.geometry.gantry import ImageAxes

Plane = Literal["single", "A", "B"]
Pair = tuple[float, float]
Point = tuple[float, float, float]

SIMULATED_EQUIPMENT = ("fluoromap", "simulated C-arm")
"""Manufacturer (0008,0070) and ManufacturerModelName (0008,1090) of simulated runs."""

_UID = re.compile(r"[0-9]+(\.[0-9]+)*")


class HeaderWarning(StrEnum):
    """Oddities of a header that the service can work with; ``sentence`` explains them to a PACS engineer."""

    FRAME_TIME_ASSUMED = "frame_time_assumed"
    PIXEL_SPACING_FROM_FIELD_OF_VIEW = "pixel_spacing_from_field_of_view"
    PIXEL_SPACING_FROM_INTENSIFIER = "pixel_spacing_from_intensifier"
    SOURCE_ISOCENTRE_FROM_MAGNIFICATION = "source_isocentre_from_magnification"
    ANGLES_FROM_ISOCENTRE = "angles_from_isocentre"
    GEOMETRY_IMPLAUSIBLE = "geometry_implausible"
    ORIENTATION_CONFLICT = "orientation_conflict"
    ORIENTATION_UNUSABLE = "orientation_unusable"
    POSITIONER_MOVED = "positioner_moved"
    TABLE_MOVED = "table_moved"
    PIXEL_INTENSITY_UNKNOWN = "pixel_intensity_unknown"
    BITS_STORED_EXCEEDED = "bits_stored_exceeded"
    PIXEL_DATA_LONGER = "pixel_data_longer"
    SHUTTER_IGNORED = "shutter_ignored"
    WINDOW_IGNORED = "window_ignored"
    R_WAVES_IGNORED = "r_waves_ignored"
    PATIENT_OR_STUDY_REPAIRED = "patient_or_study_repaired"

    @property
    def sentence(self) -> str:
        """The warning in a sentence."""
        return _SENTENCES[self]


_SENTENCES: dict[HeaderWarning, str] = {
    HeaderWarning.FRAME_TIME_ASSUMED: "The header has no frame rate; the service assumes 15 frames a second.",
    HeaderWarning.PIXEL_SPACING_FROM_FIELD_OF_VIEW: (
        "ImagerPixelSpacing is missing; the service uses FieldOfViewDimensions divided by the matrix size."
    ),
    HeaderWarning.PIXEL_SPACING_FROM_INTENSIFIER: (
        "ImagerPixelSpacing is missing; the service uses IntensifierSize divided by the matrix size."
    ),
    HeaderWarning.SOURCE_ISOCENTRE_FROM_MAGNIFICATION: (
        "DistanceSourceToPatient is missing; the service computes it from EstimatedRadiographicMagnificationFactor."
    ),
    HeaderWarning.ANGLES_FROM_ISOCENTRE: (
        "PositionerPrimaryAngle and PositionerSecondaryAngle are missing; the service computes them from the angles about the "
        "isocentre and the patient's position."
    ),
    HeaderWarning.GEOMETRY_IMPLAUSIBLE: "A geometry attribute has a value that no C-arm can have; it counts as missing.",
    HeaderWarning.ORIENTATION_CONFLICT: (
        "PatientOrientation contradicts FieldOfViewRotation or FieldOfViewHorizontalFlip; the service uses the field of view."
    ),
    HeaderWarning.ORIENTATION_UNUSABLE: (
        "PatientOrientation or FieldOfViewRotation does not fit the gantry angles; the service assumes an upright image."
    ),
    HeaderWarning.POSITIONER_MOVED: "The gantry turned during this run; a job cannot use it.",
    HeaderWarning.TABLE_MOVED: (
        "The table moved during this run; the service uses its first position only, and trusts the site less."
    ),
    HeaderWarning.PIXEL_INTENSITY_UNKNOWN: (
        "PixelIntensityRelationship is missing; the service assumes pixels prepared for display."
    ),
    HeaderWarning.BITS_STORED_EXCEEDED: "The pixels use more bits than BitsStored says; the service uses the larger number.",
    HeaderWarning.PIXEL_DATA_LONGER: "There is more pixel data than NumberOfFrames says; the service ignores the rest.",
    HeaderWarning.SHUTTER_IGNORED: "A shutter or collimator attribute makes no sense; the service ignores it.",
    HeaderWarning.WINDOW_IGNORED: (
        "The display window lies beside the values that the pixels can have; the service shows the range of the picture."
    ),
    HeaderWarning.R_WAVES_IGNORED: "RWavePointer names frames that do not exist; the service ignores them.",
    HeaderWarning.PATIENT_OR_STUDY_REPAIRED: (
        "An attribute of the patient or the study, or SpecificCharacterSet, breaks the rules of DICOM; results carry it repaired "
        "or empty."
    ),
}


class TableOrigin(StrEnum):
    """The attributes that state a table's position; positions of different attributes have different origins."""

    ISOCENTRE = "isocentre"
    """TableXPositionToIsocenter (0018,9466) to TableZPositionToIsocenter (0018,9468)."""
    TABLE_TOP = "table_top"
    """TableTopVerticalPosition (300A,0128) to TableTopLateralPosition (300A,012A)."""
    GE = "ge"
    """The private block DLX_SERIE_01 of GE."""


@dataclass(frozen=True, slots=True)
class InstanceFacts:
    """One run by the header of its file.

    Parameters
    ----------
    sop_class_uid, sop_instance_uid, study_instance_uid, series_instance_uid : str
    series_number : int or None
    frames, rows, columns : int
    transfer_syntax : str
        UID of the pixel data's encoding.
    frame_times_ms : tuple of float
        Time of each frame from the first on, never falling.
    frame_time_ms : float
        Mean interval; 0 for a single frame.
    acquired : datetime or None
        Earliest start of the run, UTC. A time without zone in the file counts as UTC: it serves to order runs only.
    plane : {"single", "A", "B"}
        Plane of a biplane system.
    primary_deg, secondary_deg, source_detector_mm, source_isocentre_mm, pixel_spacing_mm
        Gantry values as in :class:`fluoromap.geometry.Gantry`; None where the header has no value.
    image_axes : ImageAxes
        Upright to stored offsets, as in :class:`fluoromap.geometry.Gantry`.
    patient_orientation : tuple of str or None
        PatientOrientation's row and column direction, for :func:`image_axes_from_orientation` once angles are known.
    table_mm : tuple of float or None
        Table top along the patient's axes (LPS: x, y, z). Only differences between runs with the same ``table_origin`` have a
        meaning.
    pixels : PixelFacts
    window : tuple of float or None
        The file's display window (centre, width) in stored values.
    r_wave_frames : tuple of int
        Frames of R waves, from 0.
    missing : tuple of str
        DICOM keywords of gantry values that neither the header nor a substitute gives.
    warnings : tuple of HeaderWarning
    table_origin : TableOrigin or None
        The attributes that state ``table_mm``; None where the position is unknown.
    simulated : bool
        True for a run that ``fluoromap simulate`` wrote.
    acquired_within_s : float
        Seconds after ``acquired`` within which the run began, by the precision of the header.
    acquired_zone_known : bool
        Whether the header states the offset of ``acquired`` from UTC.

    Raises
    ------
    ValueError
        When the numbers contradict each other.
    """

    sop_class_uid: str
    sop_instance_uid: str
    study_instance_uid: str
    series_instance_uid: str
    series_number: int | None
    frames: int
    rows: int
    columns: int
    transfer_syntax: str
    frame_times_ms: tuple[float, ...]
    frame_time_ms: float
    acquired: datetime | None
    plane: Plane
    primary_deg: float | None
    secondary_deg: float | None
    source_detector_mm: float | None
    source_isocentre_mm: float | None
    pixel_spacing_mm: Pair | None
    image_axes: ImageAxes
    patient_orientation: tuple[str, str] | None
    table_mm: Point | None
    pixels: PixelFacts
    window: Pair | None
    r_wave_frames: tuple[int, ...]
    missing: tuple[str, ...]
    warnings: tuple[HeaderWarning, ...]
    table_origin: TableOrigin | None = None
    simulated: bool = False
    acquired_within_s: float = 0.0
    acquired_zone_known: bool = False

    def __post_init__(self) -> None:
        uids = (self.sop_class_uid, self.sop_instance_uid, self.study_instance_uid, self.series_instance_uid)
        if not all(is_uid(uid) for uid in uids):
            raise ValueError("an instance needs valid UIDs: digits and dots, at most 64 characters")
        if min(self.frames, self.rows, self.columns) < 1:
            raise ValueError("a run has at least one frame of at least one pixel")
        times = self.frame_times_ms
        if len(times) != self.frames or any(later < earlier for earlier, later in itertools.pairwise(times)):
            raise ValueError("frame_times_ms needs one time a frame, never falling")
        if self.acquired is not None and self.acquired.utcoffset() is None:
            raise ValueError("acquired needs a time zone")
        if not all(0 <= frame < self.frames for frame in self.r_wave_frames):
            raise ValueError("r_wave_frames must be frames of the run")

    def to_json(self) -> dict[str, Any]:
        """Return all fields as JSON types, for :meth:`from_json`."""
        value = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        # Not by asdict or _lists, which visit the time of each frame: a job of many runs would wait for it.
        value["frame_times_ms"] = None
        value["pixels"] = dataclasses.asdict(self.pixels)
        value["acquired"] = self.acquired.isoformat() if self.acquired else None
        value["warnings"] = [str(warning) for warning in self.warnings]
        value["table_origin"] = str(self.table_origin) if self.table_origin else None
        listed: dict[str, Any] = _lists(value)
        listed["frame_times_ms"] = list(self.frame_times_ms)
        return listed

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> InstanceFacts:
        """Return the instance that :meth:`to_json` wrote."""
        fields: dict[str, Any] = {key: _tuples(item) for key, item in value.items()}
        pixels = dict(fields["pixels"])
        shutter = pixels["shutter"]
        pixels["shutter"] = Shutter(**shutter) if shutter else None
        acquired, table_origin = fields["acquired"], fields.get("table_origin")
        return cls(
            **fields
            | {
                "pixels": PixelFacts(**pixels),
                "acquired": datetime.fromisoformat(acquired) if acquired else None,
                "warnings": tuple(HeaderWarning(code) for code in fields["warnings"]),
                "table_origin": TableOrigin(table_origin) if table_origin else None,
            }
        )


def is_uid(value: str) -> bool:
    """Return whether ``value`` is a UID of PS3.5 section 9.1.

    Leading zeros pass, because real systems write them.
    """
    return len(value) <= 64 and _UID.fullmatch(value) is not None


def _lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _lists(item) for key, item in value.items()}
    return [_lists(item) for item in value] if isinstance(value, list | tuple) else value


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, list | tuple) else value
