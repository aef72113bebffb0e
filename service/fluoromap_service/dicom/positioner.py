"""Positions of gantry and table by the header."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from fluoromap.geometry.gantry import LEAST_SOURCE_MM, UPRIGHT, ImageAxes
from fluoromap_service.dicom.facts import HeaderWarning, Pair, Point, TableOrigin
from fluoromap_service.dicom.header import Header
from fluoromap_service.dicom.orientation import image_axes_from_field_of_view, image_axes_from_orientation

_STILL_DEG = 0.5
_STILL_MM = 1.0

_TABLE_ANGLES = ("TableAngle", "TableHorizontalRotationAngle", "TableHeadTiltAngle", "TableCradleTiltAngle")
# Codes of PS3.16 CID 20 and CID 21, in SNOMED CT and in its older form.
_LYING = {"40199007": "S", "F-10340": "S", "1240000": "P", "F-10310": "P"}
_ENTERING = {"102540008": "HF", "F-10470": "HF", "102541007": "FF", "F-10480": "FF"}
# Degrees from an angle about the table to the angle about the patient.
_TURN_OF_POSITION = {"HFS": 0.0, "HFP": 180.0}
# Signs of the patient's axes (LPS) along the axes of a patient who lies on the back with the head first. PS3.3 C.7.3.1.1.2.
_AXES_OF_POSITION = {"HFS": (1, 1, 1), "HFP": (-1, -1, 1), "FFS": (-1, 1, -1), "FFP": (1, -1, -1)}


@dataclass(frozen=True, slots=True)
class GantryFacts:
    """The gantry values of a header, None where it has none; fields as in ``InstanceFacts``."""

    primary_deg: float | None
    secondary_deg: float | None
    source_detector_mm: float | None
    source_isocentre_mm: float | None
    pixel_spacing_mm: Pair | None
    missing: tuple[str, ...]


def gantry_facts(header: Header, rows: int, columns: int, warnings: list[HeaderWarning]) -> GantryFacts:
    """Return the gantry values of legacy XA (PS3.3 C.8.7.5, C.8.7.3) or Enhanced XA (C.8.19.6).

    A value that no C-arm can have counts as absent. So does a distance of 0, which some systems write for "unknown". Angles
    about the patient (C.8.7.5.1.2) come before those about the isocentre, which need the position of the patient.
    """
    primary = _within(header.number("PositionerPrimaryAngle"), -180, 180, warnings)
    secondary = _within(header.number("PositionerSecondaryAngle"), -90, 90, warnings)
    if primary is None and secondary is None and (angles := _angles_about_isocentre(header, warnings)) is not None:
        primary, secondary = angles
        _warn(warnings, HeaderWarning.ANGLES_FROM_ISOCENTRE)
    detector = _within(header.number("DistanceSourceToDetector") or None, LEAST_SOURCE_MM, 3000, warnings)
    isocentre = _source_isocentre_mm(header, detector, warnings)
    spacing = _pixel_spacing_mm(header, rows, columns, warnings)
    values = {
        "PositionerPrimaryAngle": primary,
        "PositionerSecondaryAngle": secondary,
        "DistanceSourceToDetector": detector,
        "DistanceSourceToPatient": isocentre,
        "ImagerPixelSpacing": spacing,
    }
    missing = tuple(keyword for keyword, value in values.items() if value is None)
    return GantryFacts(primary, secondary, detector, isocentre, spacing, missing)


def _angles_about_isocentre(header: Header, warnings: list[HeaderWarning]) -> Pair | None:
    """Return primary and secondary angle about the patient, from those about the isocentre (PS3.3 C.8.19.6.13.1.2).

    X of the isocentre system is the left of the table, Y is down, Z is the head of the table. Both pairs of angles turn the
    detector from -Y first towards X, then towards Z. None for a patient who lies otherwise than head first and on back or
    front, for a table that is not level, and for a detector that is turned in its plane: there the picture is not upright.
    """
    turn = _TURN_OF_POSITION.get(patient_position(header))
    primary = _within(header.number("PositionerIsocenterPrimaryAngle"), -180, 180, warnings)
    secondary = _within(header.number("PositionerIsocenterSecondaryAngle"), -90, 90, warnings)
    rotated = abs(header.number("PositionerIsocenterDetectorRotationAngle") or 0.0) > _STILL_DEG
    if turn is None or primary is None or secondary is None or rotated or _is_tilted(header):
        return None
    return (primary + turn + 180) % 360 - 180, secondary


def patient_position(header: Header) -> str:
    """Return how the patient lies, in the terms of PatientPosition.

    These are HFS, HFP, FFS, FFP or another value. Enhanced objects may state it by codes. "" where the header does not state it.
    """
    stated = header.text("PatientPosition")
    if stated:
        return stated
    entering = _ENTERING.get(header.code("PatientGantryRelationshipCodeSequence"), "")
    lying = _LYING.get(header.code("PatientOrientationCodeSequence", "PatientOrientationModifierCodeSequence"), "")
    return entering + lying if entering and lying else ""


def _is_tilted(header: Header) -> bool:
    """Return whether the table is tilted or turned.

    Then its axes are not those of the isocentre.
    """
    return any(abs(header.number(angle) or 0.0) > _STILL_DEG for angle in _TABLE_ANGLES)


def _within(value: float | None, low: float, high: float, warnings: list[HeaderWarning]) -> float | None:
    if value is None or low <= value <= high:
        return value
    _warn(warnings, HeaderWarning.GEOMETRY_IMPLAUSIBLE)
    return None


def _warn(warnings: list[HeaderWarning], warning: HeaderWarning) -> None:
    if warning not in warnings:
        warnings.append(warning)


def _source_isocentre_mm(header: Header, detector_mm: float | None, warnings: list[HeaderWarning]) -> float | None:
    farthest = detector_mm - 1e-3 if detector_mm else 3000
    distance = header.number("DistanceSourceToIsocenter") or header.number("DistanceSourceToPatient") or None
    isocentre = _within(distance, LEAST_SOURCE_MM, farthest, warnings)
    if isocentre is not None or detector_mm is None:
        return isocentre
    # ERMF = SID / SOD, PS3.3 C.8.7.5.
    magnification = header.number("EstimatedRadiographicMagnificationFactor")
    if magnification is None or magnification <= 1 or detector_mm / magnification < LEAST_SOURCE_MM:
        return None
    _warn(warnings, HeaderWarning.SOURCE_ISOCENTRE_FROM_MAGNIFICATION)
    return detector_mm / magnification


def _pixel_spacing_mm(header: Header, rows: int, columns: int, warnings: list[HeaderWarning]) -> Pair | None:
    """Return row and column spacing at the detector.

    The service never uses PixelSpacing (0028,0030), because some systems divide it by the magnification.
    """
    stated = header.numbers("ImagerPixelSpacing")
    if len(stated) == 2 and any(stated):
        if all(0.01 <= value <= 5 for value in stated):
            return stated[0], stated[1]
        _warn(warnings, HeaderWarning.GEOMETRY_IMPLAUSIBLE)
    substitutes = (
        (
            HeaderWarning.PIXEL_SPACING_FROM_FIELD_OF_VIEW,
            header.numbers("FieldOfViewDimensionsInFloat") or header.numbers("FieldOfViewDimensions"),
        ),
        (HeaderWarning.PIXEL_SPACING_FROM_INTENSIFIER, header.numbers("IntensifierSize")),
    )
    for warning, size in substitutes:
        if not 1 <= len(size) <= 2:
            continue
        # Systems write the two dimensions in either order. Pixels are square: take the order that makes them square.
        orders = ((size[0], size[-1]), (size[-1], size[0]))
        height, width = min(orders, key=lambda order: abs(order[0] * columns - order[1] * rows))
        spacing = height / rows, width / columns
        if all(0.01 <= value <= 5 for value in spacing):
            _warn(warnings, warning)
            return spacing
    return None


def image_axes(header: Header, gantry: GantryFacts, warnings: list[HeaderWarning]) -> ImageAxes:
    """Return the image axes.

    They follow from the field of view's rotation and flip, otherwise from PatientOrientation.
    """
    by_view = _by_field_of_view(header, warnings)
    orientation = orientation_letters(header)
    by_patient: ImageAxes | None = None
    if orientation is not None and gantry.primary_deg is not None and gantry.secondary_deg is not None:
        by_patient = image_axes_from_orientation(orientation, gantry.primary_deg, gantry.secondary_deg)
        if by_patient is None:
            _warn(warnings, HeaderWarning.ORIENTATION_UNUSABLE)
    if by_view is not None and by_patient is not None and by_view != by_patient:
        _warn(warnings, HeaderWarning.ORIENTATION_CONFLICT)
    return by_view or by_patient or UPRIGHT


def _by_field_of_view(header: Header, warnings: list[HeaderWarning]) -> ImageAxes | None:
    rotation, flip = header.number("FieldOfViewRotation"), header.text("FieldOfViewHorizontalFlip")
    if rotation is None and not flip:
        return None
    axes = image_axes_from_field_of_view(rotation or 0.0, flip == "YES")
    if axes is None:
        _warn(warnings, HeaderWarning.ORIENTATION_UNUSABLE)
    return axes


def orientation_letters(header: Header) -> tuple[str, str] | None:
    """Return PatientOrientation (0020,0020) as two strings of letters; None when absent."""
    letters = header.texts("PatientOrientation")
    return (letters[0], letters[1]) if len(letters) == 2 and all(letters) else None


def table_position(header: Header) -> tuple[Point | None, TableOrigin | None]:
    """Return the table top's position and the origin it counts from.

    The position is in millimetres along the patient's axes (LPS). Both are None unless all three values exist.

    The standard's words "lateral" and "longitudinal" are those of an operator at the table's side, who faces the patient:
    lateral is towards the head, longitudinal towards the patient's left (PS3.3 C.8.7.4.1.3, C.8.19.6.11). In GE's private
    block lateral is towards the left, longitudinal towards the head, as recordings of a phantom have shown. Vertical is
    downwards everywhere. The position of a tilted or turned table counts as unknown, because its axes are not the patient's.
    """
    signs = _AXES_OF_POSITION.get(patient_position(header) or "HFS")
    if signs is None or _is_tilted(header):
        return None, None
    stated = {
        TableOrigin.ISOCENTRE: [header.number(f"Table{axis}PositionToIsocenter") for axis in "XYZ"],
        TableOrigin.TABLE_TOP: [
            header.number(f"TableTop{name}Position") for name in ("Longitudinal", "Vertical", "Lateral")
        ],
        TableOrigin.GE: [header.private_number("DLX_SERIE_01", element) for element in (0x23, 0x21, 0x22)],
    }
    for origin, (x, y, z) in stated.items():
        if x is not None and y is not None and z is not None:
            return (signs[0] * x, signs[1] * y, signs[2] * z), origin
    return None, None


def warn_of_motion(header: Header, warnings: list[HeaderWarning]) -> None:
    """Warn when gantry or table moved during the run.

    Legacy XA has increments (0018,1520), (0018,1521), (0018,1135) to (0018,1137); Enhanced XA has functional groups that
    differ between frames. A cine that is DYNAMIC without such values has moved by an unknown amount.
    """
    gantry = [
        _changes(
            header, "PositionerMotion", f"Positioner{axis}Increment", f"Positioner{axis}", f"PositionerIsocenter{axis}"
        )
        for axis in ("PrimaryAngle", "SecondaryAngle")
    ]
    detector = max(_spread_of_frames(header, "DistanceSourceToDetector"), default=0.0)
    if _moved(header, "PositionerMotion", gantry, _STILL_DEG) or detector > _STILL_MM:
        _warn(warnings, HeaderWarning.POSITIONER_MOVED)
    table = [
        _changes(
            header,
            "TableMotion",
            f"Table{name}Increment",
            f"TableTop{name}Position",
            f"Table{letter}PositionToIsocenter",
        )
        for name, letter in (("Lateral", "X"), ("Longitudinal", "Z"), ("Vertical", "Y"))
    ]
    if _moved(header, "TableMotion", table, _STILL_MM):
        _warn(warnings, HeaderWarning.TABLE_MOVED)


def _moved(header: Header, motion: str, changes: list[list[float]], still: float) -> bool:
    stated = [change for axis in changes for change in axis]
    if not stated:
        return header.text(motion) == "DYNAMIC" and (header.integer("NumberOfFrames") or 1) > 1
    return max(stated) > still


def _changes(header: Header, motion: str, increments: str, *per_frame: str) -> list[float]:
    """Return the largest change of a value by each attribute that states it.

    Legacy XA gives each frame's difference from the first frame (``increments``): the largest absolute value counts. Some
    systems write the difference from the frame before: where the motion is DYNAMIC, the sum of the differences counts too.
    Enhanced XA gives the value of each frame (``per_frame``): the largest value less the smallest counts.
    """
    values = header.numbers(increments)
    changes = [max(abs(value) for value in values)] if values else []
    if values and header.text(motion) == "DYNAMIC":
        changes.append(max(abs(total) for total in itertools.accumulate(values)))
    for keyword in per_frame:
        changes += _spread_of_frames(header, keyword)
    return changes


def _spread_of_frames(header: Header, keyword: str) -> list[float]:
    values = [numbers[0] for numbers in header.numbers_per_frame(keyword) if numbers]
    return [max(values) - min(values)] if values else []
