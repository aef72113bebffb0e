"""Gantry, orientation and table as headers state them: legacy and Enhanced XA, substitutes, and nonsense."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydicom.dataset import Dataset
from pydicom.uid import EnhancedXAImageStorage, ExplicitVRLittleEndian, ImplicitVRLittleEndian

from fluoromap.geometry import Gantry, camera_from_gantry, view_axes
from fluoromap.geometry.gantry import UPRIGHT, ImageAxes
from fluoromap_service.dicom import HeaderWarning, InstanceFacts, image_axes_from_orientation, read_instance
from fluoromap_service.dicom.facts import TableOrigin
from fluoromap_service.dicom.orientation import (
    field_of_view_of,
    image_axes_from_field_of_view,
    patient_orientation,
)

MakeXa = Callable[..., Path]
FRAMES = np.arange(3 * 8 * 16, dtype=np.uint16).reshape(3, 8, 16)
ALL_AXES: list[ImageAxes] = [
    axes
    for turns, flip in itertools.product((0, 90, 180, 270), (False, True))
    if (axes := image_axes_from_field_of_view(turns, flip))
]
angles = st.tuples(st.floats(-179, 179), st.floats(-50, 50))


def facts(make_xa: MakeXa, **attributes: Any) -> InstanceFacts:
    return read_instance(make_xa(FRAMES, **attributes))


def test_all_that_is_missing_is_listed(make_xa: MakeXa) -> None:
    assert facts(make_xa).missing == (
        "PositionerPrimaryAngle",
        "PositionerSecondaryAngle",
        "DistanceSourceToDetector",
        "DistanceSourceToPatient",
        "ImagerPixelSpacing",
    )


def test_source_distance_from_magnification(make_xa: MakeXa) -> None:
    found = facts(make_xa, DistanceSourceToDetector=1000, EstimatedRadiographicMagnificationFactor=1.25)
    assert found.source_isocentre_mm == pytest.approx(800)
    assert HeaderWarning.SOURCE_ISOCENTRE_FROM_MAGNIFICATION in found.warnings
    assert "DistanceSourceToPatient" not in found.missing


def test_zero_distances_are_unknown_distances(make_xa: MakeXa) -> None:
    found = facts(make_xa, DistanceSourceToDetector=0, DistanceSourceToPatient=0)
    assert (found.source_detector_mm, found.source_isocentre_mm) == (None, None)


@pytest.mark.parametrize(
    "changes",
    [
        {"PositionerPrimaryAngle": 400},
        {"PositionerSecondaryAngle": -95},
        {"DistanceSourceToDetector": 1000, "DistanceSourceToPatient": 1200},
        {"DistanceSourceToDetector": 1e6},
        {"ImagerPixelSpacing": [400, 400]},
    ],
)
def test_impossible_geometry_counts_as_missing(make_xa: MakeXa, changes: dict[str, Any]) -> None:
    found = facts(make_xa, **changes)
    assert HeaderWarning.GEOMETRY_IMPLAUSIBLE in found.warnings
    assert list(changes)[-1] in found.missing


def test_spacing_from_the_field_of_view_or_the_intensifier(make_xa: MakeXa) -> None:
    field = facts(make_xa, FieldOfViewShape="RECTANGLE", FieldOfViewDimensions=[32, 16], IntensifierSize=230)
    assert field.pixel_spacing_mm == (2.0, 2.0)
    assert HeaderWarning.PIXEL_SPACING_FROM_FIELD_OF_VIEW in field.warnings
    intensifier = facts(make_xa, IntensifierSize=16)
    assert intensifier.pixel_spacing_mm == (2.0, 1.0)
    assert HeaderWarning.PIXEL_SPACING_FROM_INTENSIFIER in intensifier.warnings


def test_calibrated_spacing_is_never_taken(make_xa: MakeXa) -> None:
    found = facts(make_xa, PixelSpacing=[0.2, 0.2])
    assert found.pixel_spacing_mm is None
    assert "ImagerPixelSpacing" in found.missing
    assert facts(make_xa, PixelSpacing=[0.2, 0.2], ImagerPixelSpacing=[0.3, 0.4]).pixel_spacing_mm == (0.3, 0.4)


def test_upright_axes_are_the_cameras(gantry: Gantry) -> None:
    camera = camera_from_gantry(gantry)
    axes = view_axes(gantry.primary_deg, gantry.secondary_deg)[:2]
    moved = camera.project(axes) - camera.project(np.zeros(3))
    np.testing.assert_allclose(moved / np.linalg.norm(moved, axis=1, keepdims=True), np.eye(2), atol=1e-12)


def test_frontal_view_is_left_and_feet() -> None:
    assert patient_orientation(0, 0) == ("L", "F")
    assert patient_orientation(90, 0) == ("P", "F")
    assert image_axes_from_orientation(("L", "F"), 0, 0) == UPRIGHT
    assert image_axes_from_orientation(("R", "F"), 0, 0) == ((-1, 0), (0, 1))
    assert image_axes_from_orientation(("R", "H"), 0, 0) == ((-1, 0), (0, -1))


def test_clockwise_turn() -> None:
    """A frontal view turned clockwise by 90 degrees has the head on its right and the patient's left at its foot."""
    turned = image_axes_from_field_of_view(90, False)
    assert turned is not None
    assert patient_orientation(0, 0, turned) == ("H", "L")
    mirrored = image_axes_from_field_of_view(90, True)
    assert mirrored is not None
    assert patient_orientation(0, 0, mirrored) == ("F", "L")


@given(angles, st.sampled_from(ALL_AXES))
def test_orientation_gives_every_flip_and_turn(pose: tuple[float, float], axes: ImageAxes) -> None:
    letters = patient_orientation(*pose, axes)
    assert image_axes_from_orientation(letters, *pose) == axes
    assert image_axes_from_field_of_view(*field_of_view_of(axes)) == axes


@pytest.mark.parametrize("letters", [("", "F"), ("X", "F"), ("LR", "F"), ("L",), ("A", "P"), ("H", "H")])
def test_orientations_that_fit_nothing(letters: tuple[str, ...]) -> None:
    assert image_axes_from_orientation(letters, 0, 0) is None


def test_orientation_in_a_header(make_xa: MakeXa) -> None:
    lateral = {"PositionerPrimaryAngle": -90, "PositionerSecondaryAngle": 0}
    assert facts(make_xa, PatientOrientation=["P", "F"], **lateral).image_axes == ((-1, 0), (0, 1))
    assert facts(make_xa, PatientOrientation=["A", "F"], **lateral).image_axes == UPRIGHT
    unknown = facts(make_xa, PatientOrientation=["P", "F"])
    assert (unknown.image_axes, unknown.patient_orientation) == (UPRIGHT, ("P", "F"))
    useless = facts(make_xa, PatientOrientation=["R", "L"], **lateral)
    assert useless.image_axes == UPRIGHT
    assert HeaderWarning.ORIENTATION_UNUSABLE in useless.warnings
    conflict = facts(make_xa, PatientOrientation=["P", "F"], FieldOfViewHorizontalFlip="NO", **lateral)
    assert conflict.image_axes == UPRIGHT
    assert HeaderWarning.ORIENTATION_CONFLICT in conflict.warnings


@pytest.mark.parametrize("axes", ALL_AXES)
def test_camera_of_a_turned_image_shows_the_same_patient(axes: ImageAxes) -> None:
    """Where the header's letters say a point lies is where the camera puts it."""
    turned = camera_from_gantry(Gantry(20, 10, 1000, 750, (0.4, 0.4), 100, 100, axes))
    right, down = patient_orientation(20, 10, axes)
    signs = {"L": (0, 1), "R": (0, -1), "P": (1, 1), "A": (1, -1), "H": (2, 1), "F": (2, -1)}
    for letters, column in ((right, 0), (down, 1)):
        axis, sign = signs[letters[0]]
        point = np.zeros(3)
        point[axis] = 10.0 * sign
        assert (turned.project(point) - turned.principal_point_uv)[column] > 10


def test_motion_during_the_run(make_xa: MakeXa) -> None:
    assert facts(make_xa, PositionerPrimaryAngleIncrement=[0, 0, 0]).warnings == ()
    turned = facts(make_xa, PositionerMotion="DYNAMIC", PositionerPrimaryAngleIncrement=[0, 10, 20])
    assert turned.warnings == (HeaderWarning.POSITIONER_MOVED,)
    panned = facts(make_xa, TableMotion="DYNAMIC", TableLongitudinalIncrement=[0, -3, -9])
    assert panned.warnings == (HeaderWarning.TABLE_MOVED,)


@pytest.mark.parametrize(
    ("image_type", "plane"),
    [
        (["ORIGINAL", "PRIMARY", "BIPLANE A"], "A"),
        (["ORIGINAL", "PRIMARY", "BIPLANE B"], "B"),
        (["ORIGINAL"], "single"),
    ],
)
def test_plane(make_xa: MakeXa, image_type: list[str], plane: str) -> None:
    assert facts(make_xa, ImageType=image_type).plane == plane


def group(**macros: dict[str, Any]) -> Dataset:
    item = Dataset()
    for sequence, attributes in macros.items():
        inner = Dataset()
        for keyword, value in attributes.items():
            setattr(inner, keyword, value)
        setattr(item, sequence, [inner])
    return item


def enhanced(make_xa: MakeXa, angles_deg: list[float], table_mm: list[float]) -> InstanceFacts:
    shared = group(
        XRayGeometrySequence={"DistanceSourceToDetector": 1050.0, "DistanceSourceToIsocenter": 770.0},
        FramePixelDataPropertiesSequence={"ImagerPixelSpacing": [0.3, 0.3], "PixelIntensityRelationship": "LOG"},
        FieldOfViewSequence={"FieldOfViewHorizontalFlip": "YES", "FieldOfViewRotation": 0},
        CollimatorShapeSequence={
            "CollimatorShape": "RECTANGULAR",
            "CollimatorLeftVerticalEdge": 2,
            "CollimatorRightVerticalEdge": 15,
            "CollimatorUpperHorizontalEdge": 1,
            "CollimatorLowerHorizontalEdge": 8,
        },
    )
    per_frame = [
        group(
            PositionerPositionSequence={"PositionerPrimaryAngle": angle, "PositionerSecondaryAngle": -5.0},
            TablePositionSequence={
                "TableTopVerticalPosition": 900.0,
                "TableTopLongitudinalPosition": longitudinal,
                "TableTopLateralPosition": 3.0,
            },
            FrameContentSequence={"FrameAcquisitionDateTime": f"20240102030405.{100 + 50 * number}"},
        )
        for number, (angle, longitudinal) in enumerate(zip(angles_deg, table_mm, strict=True))
    ]
    return facts(
        make_xa,
        SOPClassUID=EnhancedXAImageStorage,
        PixelIntensityRelationship=None,
        FrameTime=None,
        PlanesInAcquisition="BIPLANE",
        PlaneIdentification="PLANE B",
        SharedFunctionalGroupsSequence=[shared],
        PerFrameFunctionalGroupsSequence=per_frame,
    )


def test_enhanced_xa(make_xa: MakeXa) -> None:
    found = enhanced(make_xa, [30, 30, 30], [100, 100, 100])
    assert (found.primary_deg, found.secondary_deg) == (30, -5)
    assert (found.source_detector_mm, found.source_isocentre_mm) == (1050, 770)
    assert found.pixel_spacing_mm == (0.3, 0.3)
    assert found.image_axes == ((-1, 0), (0, 1))
    # Lateral is head to foot and longitudinal left to right, PS3.3 C.8.19.6.11 and C.8.7.4.1.3.
    assert (found.table_mm, found.table_origin) == ((100, 900, 3), TableOrigin.TABLE_TOP)
    assert found.plane == "B"
    assert found.pixels.logarithmic
    assert found.pixels.shutter is not None
    assert found.pixels.shutter.rectangle == (1, 14, 0, 7)
    assert found.frame_times_ms == pytest.approx((0, 50, 100))
    assert (found.missing, found.warnings) == ((), ())


def test_enhanced_xa_that_moved(make_xa: MakeXa) -> None:
    found = enhanced(make_xa, [30, 35, 40], [100, 102, 110])
    assert set(found.warnings) == {HeaderWarning.POSITIONER_MOVED, HeaderWarning.TABLE_MOVED}
    assert found.primary_deg == 30


def code_item(value: str) -> Dataset:
    item = Dataset()
    item.CodeValue = value
    return item


def about_isocentre(
    make_xa: MakeXa, angles_deg: list[tuple[float, float]], system: dict[str, float] | None = None, **attributes: Any
) -> InstanceFacts:
    """Return the facts of a run with angles about the isocentre."""
    per_frame = [
        group(
            IsocenterReferenceSystemSequence={
                "PositionerIsocenterPrimaryAngle": primary,
                "PositionerIsocenterSecondaryAngle": secondary,
                "PositionerIsocenterDetectorRotationAngle": 0.0,
                "TableHeadTiltAngle": 0.0,
                **(system or {}),
            }
        )
        for primary, secondary in angles_deg
    ]
    return facts(
        make_xa, SOPClassUID=EnhancedXAImageStorage, PerFrameFunctionalGroupsSequence=per_frame, **attributes
    )  # fmt: skip


def by_codes(lying: str, entering: str) -> dict[str, list[Dataset]]:
    orientation = code_item("102538003")
    orientation.PatientOrientationModifierCodeSequence = [code_item(lying)]
    return {
        "PatientOrientationCodeSequence": [orientation],
        "PatientGantryRelationshipCodeSequence": [code_item(entering)],
    }


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ({"PatientPosition": "HFS"}, (30, 20)),
        ({"PatientPosition": "HFP"}, (-150, 20)),
        (by_codes("40199007", "102540008"), (30, 20)),
        (by_codes("F-10310", "F-10470"), (-150, 20)),
    ],
    ids=["HFS", "HFP", "HFS by codes", "HFP by old codes"],
)
def test_angles_about_the_isocentre(make_xa: MakeXa, attributes: dict[str, Any], expected: tuple[float, float]) -> None:
    found = about_isocentre(make_xa, [(30.0, 20.0)] * 3, **attributes)
    assert found.primary_deg is not None
    assert found.secondary_deg is not None
    assert (found.primary_deg, found.secondary_deg) == pytest.approx(expected)
    assert HeaderWarning.ANGLES_FROM_ISOCENTRE in found.warnings
    assert HeaderWarning.POSITIONER_MOVED not in found.warnings
    # PS3.3 C.8.19.6.13.1.2: from the isocentre, the detector is opposite to Yp, whose axes are turned by Ap1 and then Ap2.
    ap1, ap2 = np.radians(30.0), np.radians(20.0)
    first = np.array([[np.cos(ap1), np.sin(ap1), 0], [-np.sin(ap1), np.cos(ap1), 0], [0, 0, 1]])
    second = np.array([[1, 0, 0], [0, np.cos(ap2), -np.sin(ap2)], [0, np.sin(ap2), np.cos(ap2)]])
    detector_in_room = (second @ first).T @ [0.0, -1.0, 0.0]
    detector_in_patient = detector_in_room * ([1, 1, 1] if expected[0] > 0 else [-1, -1, 1])
    np.testing.assert_allclose(view_axes(found.primary_deg, found.secondary_deg)[2], detector_in_patient, atol=1e-9)


@pytest.mark.parametrize(
    ("system", "attributes"),
    [
        ({}, {}), ({}, {"PatientPosition": "FFS"}), ({}, {"PatientPosition": "HFDL"}),
        ({}, by_codes("40199007", "102541007")), ({"TableHeadTiltAngle": 5.0}, {"PatientPosition": "HFS"}),
        ({"PositionerIsocenterDetectorRotationAngle": 90.0}, {"PatientPosition": "HFS"}),
        ({"PositionerIsocenterSecondaryAngle": 100.0}, {"PatientPosition": "HFS"}),
    ],
    ids=["position not stated", "feet first", "on the side", "feet first by codes", "tilted", "rotated", "nonsense"],
)  # fmt: skip
def test_angles_about_the_isocentre_that_say_nothing_of_the_patient(
    make_xa: MakeXa, system: dict[str, float], attributes: dict[str, Any]
) -> None:
    found = about_isocentre(make_xa, [(30.0, 20.0)] * 3, system, **attributes)
    assert {"PositionerPrimaryAngle", "PositionerSecondaryAngle"} <= set(found.missing)
    assert HeaderWarning.ANGLES_FROM_ISOCENTRE not in found.warnings


def test_angles_about_the_patient_come_first(make_xa: MakeXa) -> None:
    stated = {"PositionerPrimaryAngle": -10.0, "PositionerSecondaryAngle": 5.0}
    found = about_isocentre(make_xa, [(30.0, 20.0)] * 3, PatientPosition="HFS", **stated)
    assert (found.primary_deg, found.secondary_deg) == (-10, 5)
    assert HeaderWarning.ANGLES_FROM_ISOCENTRE not in found.warnings


def test_a_gantry_that_turns_about_the_isocentre_moves(make_xa: MakeXa) -> None:
    turning = [(30.0, 20.0), (33.0, 20.0), (36.0, 20.0)]
    assert HeaderWarning.POSITIONER_MOVED in about_isocentre(make_xa, turning, PatientPosition="HFS").warnings
    stated = {"PositionerPrimaryAngle": 30.0, "PositionerSecondaryAngle": 20.0}
    assert HeaderWarning.POSITIONER_MOVED in about_isocentre(make_xa, turning, **stated).warnings


def test_a_table_that_is_tilted_in_the_isocentre_system_has_no_position(make_xa: MakeXa) -> None:
    level, tilted = (
        about_isocentre(make_xa, [(0.0, 0.0)] * 3, {"TableHeadTiltAngle": angle, **ISOCENTRE_TABLE})
        for angle in (0.0, 5.0)
    )
    assert (level.table_mm, tilted.table_mm) == ((4, 5, 6), None)


def ge_block(dataset: Dataset, lateral: str, longitudinal: str, vertical: str, block: int = 0x10) -> None:
    """Add GE's private table position; ``block``: the creator's element number."""
    dataset.add_new((0x0019, block), "LO", "DLX_SERIE_01")
    for element, value in ((0x21, vertical), (0x22, longitudinal), (0x23, lateral)):
        dataset.add_new((0x0019, block << 8 | element), "DS", value)


def with_private_block(make_xa: MakeXa, change: Callable[[Dataset], None], **attributes: Any) -> InstanceFacts:
    path = make_xa(FRAMES, **attributes)
    dataset = pydicom.dcmread(path)
    change(dataset)
    dataset.save_as(path)
    return read_instance(path)


@pytest.mark.parametrize("block", [0x10, 0x11, 0xFF])
@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian])
def test_table_position_in_the_private_block_of_ge(make_xa: MakeXa, block: int, syntax: str) -> None:
    def change(dataset: Dataset) -> None:
        ge_block(dataset, "9.20", "503.90", "84", block)

    found = with_private_block(make_xa, change, syntax=syntax)
    assert (found.table_mm, found.table_origin) == ((9.2, 84.0, 503.9), TableOrigin.GE)


def test_the_same_elements_of_another_creator_are_no_table_position(make_xa: MakeXa) -> None:
    def change(dataset: Dataset) -> None:
        ge_block(dataset, "1", "2", "3")
        dataset[0x0019, 0x0010].value = "OTHER_SERIE_01"

    found = with_private_block(make_xa, change)
    assert (found.table_mm, found.table_origin) == (None, None)


def test_an_incomplete_private_table_position_is_none(make_xa: MakeXa) -> None:
    found = with_private_block(make_xa, lambda dataset: ge_block(dataset, "1", "", "3"))
    assert (found.table_mm, found.table_origin) == (None, None)


STANDARD_TABLE = {
    "TableTopLateralPosition": 3.0,
    "TableTopLongitudinalPosition": 1.0,
    "TableTopVerticalPosition": 2.0,
}
ISOCENTRE_TABLE = {
    "TableXPositionToIsocenter": 4.0,
    "TableYPositionToIsocenter": 5.0,
    "TableZPositionToIsocenter": 6.0,
}


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        (STANDARD_TABLE, ((1, 2, 3), TableOrigin.TABLE_TOP)),
        (ISOCENTRE_TABLE, ((4, 5, 6), TableOrigin.ISOCENTRE)),
        (STANDARD_TABLE | ISOCENTRE_TABLE, ((4, 5, 6), TableOrigin.ISOCENTRE)),
    ],
)
def test_standard_attributes_of_the_table_win_over_private_ones(
    make_xa: MakeXa, attributes: dict[str, float], expected: tuple[tuple[float, float, float], TableOrigin]
) -> None:
    found = with_private_block(make_xa, lambda dataset: ge_block(dataset, "9", "8", "7"), **attributes)
    assert (found.table_mm, found.table_origin) == expected


@pytest.mark.parametrize(
    ("position", "table_mm"),
    [("HFS", (1, 2, 3)), ("HFP", (-1, -2, 3)), ("FFS", (-1, 2, -3)), ("FFP", (1, -2, -3)), ("HFDL", None)],
)
def test_the_table_moves_along_the_axes_of_the_patient_as_he_lies(
    make_xa: MakeXa, position: str, table_mm: tuple[float, float, float] | None
) -> None:
    assert facts(make_xa, PatientPosition=position, **STANDARD_TABLE).table_mm == table_mm


@pytest.mark.parametrize("angle", ["TableAngle", "TableHorizontalRotationAngle", "TableHeadTiltAngle"])
def test_the_position_of_a_tilted_table_is_unknown(make_xa: MakeXa, angle: str) -> None:
    assert facts(make_xa, **{angle: 0.1}, **STANDARD_TABLE).table_mm is not None
    assert facts(make_xa, **{angle: 5.0}, **STANDARD_TABLE).table_mm is None
