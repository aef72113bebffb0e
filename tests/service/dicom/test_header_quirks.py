"""A catalogue of the ways in which real systems write their headers, each with its meaning."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from pydicom.dataset import Dataset
from pydicom.tag import Tag
from pydicom.uid import EnhancedXAImageStorage

from fluoromap_service.dicom import HeaderWarning, InstanceFacts, read_instance

MakeXa = Callable[..., Path]
FRAMES = np.arange(3 * 8 * 16, dtype=np.uint16).reshape(3, 8, 16)
POSE = {"PositionerPrimaryAngle": 30, "PositionerSecondaryAngle": 0}


@dataclass(frozen=True)
class Quirk:
    """A way of writing. header : its attributes. expected : facts that must follow. warnings : all warnings."""

    name: str
    header: dict[str, Any]
    expected: dict[str, Any]
    warnings: tuple[HeaderWarning, ...] = field(default=())


MOVED, PANNED = HeaderWarning.POSITIONER_MOVED, HeaderWarning.TABLE_MOVED
QUIRKS = [
    # Motion of the gantry and of the table.
    Quirk("motion is empty", {"PositionerMotion": "", "TableMotion": ""}, {}),
    Quirk("still, with increments of zero", {"PositionerPrimaryAngleIncrement": [0, 0, 0]}, {}),
    Quirk("still, with one increment for all frames", {"PositionerPrimaryAngleIncrement": 0}, {}),
    Quirk("still, with angles that flicker", {"PositionerPrimaryAngleIncrement": [0, 0.1, -0.1]}, {}),
    Quirk(
        "dynamic, but the increments are zero",
        {"PositionerMotion": "DYNAMIC", "PositionerPrimaryAngleIncrement": [0, 0, 0]},
        {},
    ),
    Quirk(
        "increments from the first frame", {"PositionerPrimaryAngleIncrement": [0, 0.4, 0.8], **POSE},
        {"primary_deg": 30}, (MOVED,),
    ),
    Quirk(
        "increments from the frame before",
        {"PositionerMotion": "DYNAMIC", "PositionerPrimaryAngleIncrement": [0, 0.4, 0.4]}, {}, (MOVED,),
    ),
    Quirk("increments of the secondary angle only", {"PositionerSecondaryAngleIncrement": [0, -2, -4]}, {}, (MOVED,)),
    Quirk("static, but the increments move", {"PositionerMotion": "STATIC", "PositionerPrimaryAngleIncrement": [0, 5, 9]},
          {}, (MOVED,)),
    Quirk("dynamic without increments", {"PositionerMotion": "DYNAMIC"}, {}, (MOVED,)),
    Quirk("table panned by less than a millimetre", {"TableLateralIncrement": [0, 0.3, 0.6]}, {}),
    Quirk("table panned", {"TableMotion": "DYNAMIC", "TableVerticalIncrement": [0, 1, 2]}, {}, (PANNED,)),
    Quirk("table dynamic without increments", {"TableMotion": "DYNAMIC"}, {}, (PANNED,)),
    # Planes. Some systems add the name of the single plane's tube as a fourth value.
    Quirk("single plane with a fourth value", {"ImageType": ["ORIGINAL", "PRIMARY", "SINGLE PLANE", "SINGLE A"]},
          {"plane": "single"}),
    Quirk("biplane with a fourth value", {"ImageType": ["DERIVED", "PRIMARY", "BIPLANE B", "B"]}, {"plane": "B"}),
    Quirk("image type without a plane", {"ImageType": ["ORIGINAL", "PRIMARY"]}, {"plane": "single"}),
    # Times of the frames.
    Quirk("vector with its first value", {"FrameTime": None, "FrameTimeVector": [0, 66, 67]},
          {"frame_times_ms": (0, 66, 133)}),
    Quirk("vector without its first value", {"FrameTime": None, "FrameTimeVector": [66, 67]},
          {"frame_times_ms": (0, 66, 133)}),
    Quirk("vector whose first value is an interval", {"FrameTime": None, "FrameTimeVector": [33, 33, 33]},
          {"frame_times_ms": (0, 33, 66)}),
    Quirk("vector and a frame time of zero", {"FrameTime": 0, "FrameTimeVector": [0, 40, 40]},
          {"frame_times_ms": (0, 40, 80)}),
    Quirk("pointer to a vector that does not fit", {"FrameIncrementPointer": 0x00181065, "FrameTimeVector": [0, 40]},
          {"frame_times_ms": (0, 40, 80)}),
    Quirk("rate of 0 and a display rate", {"FrameTime": 0, "CineRate": 0, "RecommendedDisplayFrameRate": 25},
          {"frame_times_ms": (0, 40, 80)}),
    # Orientation.
    Quirk("orientation is empty", {"PatientOrientation": "", **POSE}, {"image_axes": ((1, 0), (0, 1))}),
    Quirk("rotation of zero and no flip", {"FieldOfViewRotation": 0}, {"image_axes": ((1, 0), (0, 1))}),
    Quirk("flip without rotation", {"FieldOfViewHorizontalFlip": "YES"}, {"image_axes": ((-1, 0), (0, 1))}),
    Quirk("negative rotation", {"FieldOfViewRotation": -90}, {"image_axes": ((0, 1), (-1, 0))}),
    Quirk("rotation and flip", {"FieldOfViewRotation": 180, "FieldOfViewHorizontalFlip": "YES"},
          {"image_axes": ((1, 0), (0, -1))}),
    Quirk("oblique rotation", {"FieldOfViewRotation": 12}, {"image_axes": ((1, 0), (0, 1))},
          (HeaderWarning.ORIENTATION_UNUSABLE,)),
    # Distances and scale.
    Quirk("distances of zero", {"DistanceSourceToDetector": 0, "DistanceSourceToPatient": 0},
          {"source_detector_mm": None, "source_isocentre_mm": None}),
    Quirk("spacing of zero and a field of view", {"ImagerPixelSpacing": [0, 0], "FieldOfViewDimensions": [16, 32]},
          {"pixel_spacing_mm": (2.0, 2.0)}, (HeaderWarning.PIXEL_SPACING_FROM_FIELD_OF_VIEW,)),
    Quirk("a shape of the field without its size", {"FieldOfViewShape": "RECTANGLE"}, {"pixel_spacing_mm": None}),
    # Pixels.
    Quirk("display pixels with a sign", {"PixelIntensityRelationship": "DISP", "PixelIntensityRelationshipSign": 1},
          {}),
    Quirk("relationship is missing", {"PixelIntensityRelationship": None}, {}, (HeaderWarning.PIXEL_INTENSITY_UNKNOWN,)),
    Quirk("relationship of GE's cine", {"PixelIntensityRelationship": "DRM"}, {}),
]  # fmt: skip


@pytest.mark.parametrize("quirk", QUIRKS, ids=lambda quirk: quirk.name)
def test_quirk(make_xa: MakeXa, quirk: Quirk) -> None:
    facts = read_instance(make_xa(FRAMES, **quirk.header))
    assert {name: getattr(facts, name) for name in quirk.expected} == quirk.expected
    assert facts.warnings == quirk.warnings


@pytest.mark.parametrize(
    ("relationship", "sign", "logarithmic", "dark_is_high"),
    [
        ("LIN", 1, False, False), ("LIN", -1, False, True), ("LOG", 1, True, False), ("LOG", -1, True, True),
        ("DISP", 1, True, False), ("DISP", -1, True, True), ("DRM", None, True, False),
    ],
)  # fmt: skip
def test_intensity_relationships(
    make_xa: MakeXa, relationship: str, sign: int | None, logarithmic: bool, dark_is_high: bool
) -> None:
    stated = {} if sign is None else {"PixelIntensityRelationshipSign": sign}
    pixels = read_instance(make_xa(FRAMES, PixelIntensityRelationship=relationship, **stated)).pixels
    assert (pixels.logarithmic, pixels.monochrome1) == (logarithmic, dark_is_high)


def _changed(path: Path, tag: int, value: bytes) -> InstanceFacts:
    """Write a value that pydicom would refuse, and read the file."""
    content = path.read_bytes()
    dataset = pydicom.dcmread(path)
    old = str(dataset[tag].value).encode()
    element = Tag(tag)
    start = content.index(element.group.to_bytes(2, "little") + element.element.to_bytes(2, "little"))
    assert len(value) <= len(old) + len(old) % 2
    place = content.index(old, start)
    padded = value.ljust(len(old) + len(old) % 2, b" ")
    path.write_bytes(content[:place] + padded + content[place + len(padded) :])
    return read_instance(path)


@pytest.mark.parametrize("value", [b"31,30", b"abc", b"     "])
def test_angles_that_are_no_numbers_are_missing(make_xa: MakeXa, value: bytes) -> None:
    facts = _changed(make_xa(FRAMES, PositionerPrimaryAngle="31.305"), 0x00181510, value)
    assert facts.primary_deg is None
    assert "PositionerPrimaryAngle" in facts.missing


def test_increments_that_are_no_numbers_count_as_unknown_motion(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, PositionerMotion="DYNAMIC", PositionerPrimaryAngleIncrement=["0.0000001"])
    assert _changed(path, 0x00181520, b"unknown").warnings == (MOVED,)


def _item(**attributes: Any) -> Dataset:
    item = Dataset()
    for keyword, value in attributes.items():
        setattr(item, keyword, value)
    return item


def _enhanced(make_xa: MakeXa, shared: Dataset, frames: list[Dataset], **attributes: Any) -> InstanceFacts:
    path = make_xa(
        FRAMES,
        SOPClassUID=EnhancedXAImageStorage,
        FrameTime=None,
        SharedFunctionalGroupsSequence=[shared],
        PerFrameFunctionalGroupsSequence=frames,
        **attributes,
    )
    return read_instance(path)


def _clock(number: int) -> Dataset:
    return _item(FrameReferenceDateTime=f"20240102030405.{100 + 50 * number}")


def test_enhanced_orientation_and_shutter_are_in_functional_groups(make_xa: MakeXa) -> None:
    shared = _item(
        PositionerPositionSequence=[_item(PositionerPrimaryAngle=-90.0, PositionerSecondaryAngle=0.0)],
        PatientOrientationInFrameSequence=[_item(PatientOrientation=["P", "F"])],
        FrameDisplayShutterSequence=[
            _item(ShutterShape="CIRCULAR", CenterOfCircularShutter=[4, 8], RadiusOfCircularShutter=3)
        ],
    )
    facts = _enhanced(make_xa, shared, [_item(FrameContentSequence=[_clock(number)]) for number in range(3)])
    assert (facts.patient_orientation, facts.image_axes) == (("P", "F"), ((-1, 0), (0, 1)))
    assert facts.pixels.shutter is not None
    assert facts.pixels.shutter.circle == (7, 3, 3)
    assert facts.frame_times_ms == pytest.approx((0, 50, 100))


@pytest.mark.parametrize(
    ("macro", "keyword", "values", "warnings"),
    [
        ("PositionerPositionSequence", "PositionerPrimaryAngle", (20.0, 20.1, 20.0), ()),
        ("PositionerPositionSequence", "PositionerPrimaryAngle", (20.0, 21.0, 22.0), (MOVED,)),
        ("PositionerPositionSequence", "PositionerSecondaryAngle", (0.0, -1.0, -2.0), (MOVED,)),
        ("XRayGeometrySequence", "DistanceSourceToDetector", (1000.0, 1000.0, 1050.0), (MOVED,)),
        ("IsocenterReferenceSystemSequence", "TableZPositionToIsocenter", (0.0, 3.0, 6.0), (PANNED,)),
    ],
)
def test_enhanced_geometry_is_compared_between_frames(
    make_xa: MakeXa, macro: str, keyword: str, values: tuple[float, ...], warnings: tuple[HeaderWarning, ...]
) -> None:
    frames = [
        _item(**{"FrameContentSequence": [_clock(number)], macro: [_item(**{keyword: value})]})
        for number, value in enumerate(values)
    ]
    facts = _enhanced(make_xa, Dataset(), frames, PositionerMotion="DYNAMIC" if warnings == (MOVED,) else "STATIC")
    assert facts.warnings == warnings


@pytest.mark.parametrize(("name", "plane"), [("PLANE A", "A"), ("PLANE B", "B"), ("MONOPLANE", "single")])
def test_enhanced_planes(make_xa: MakeXa, name: str, plane: str) -> None:
    frames = [_item(FrameContentSequence=[_clock(number)]) for number in range(3)]
    assert _enhanced(make_xa, Dataset(), frames, PlaneIdentification=name).plane == plane
