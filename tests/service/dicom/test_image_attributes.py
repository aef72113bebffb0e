"""Timing, intensities, shutters and display as headers state them."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydicom.dataset import Dataset
from pydicom.tag import Tag
from pydicom.uid import EnhancedXAImageStorage, ExplicitVRBigEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian

from fluoromap_service.dicom import HeaderWarning, InstanceFacts, frame_to_8bit, open_frames, read_instance
from fluoromap_service.dicom.frames import frame_bytes, frame_png

MakeXa = Callable[..., Path]
FRAMES = np.arange(4 * 8 * 16, dtype=np.uint16).reshape(4, 8, 16)


def facts(make_xa: MakeXa, **attributes: Any) -> InstanceFacts:
    return read_instance(make_xa(FRAMES, **attributes))


@pytest.mark.parametrize(
    ("attributes", "times"),
    [
        ({"FrameTime": 40}, (0, 40, 80, 120)),
        ({"FrameTime": None, "FrameTimeVector": [0, 10, 20, 30]}, (0, 10, 30, 60)),
        ({"FrameTime": None, "FrameTimeVector": [10, 20, 30]}, (0, 10, 30, 60)),
        ({"FrameTime": 40, "FrameTimeVector": [0, 10, 20, 30], "FrameIncrementPointer": 0x00181063}, (0, 40, 80, 120)),
        ({"FrameTime": 40, "FrameTimeVector": [0, 10, 20, 30], "FrameIncrementPointer": 0x00181065}, (0, 10, 30, 60)),
        ({"FrameTime": 40, "FrameTimeVector": [0, 10], "FrameIncrementPointer": 0x00181065}, (0, 40, 80, 120)),
        ({"FrameTime": 0, "CineRate": 50}, (0, 20, 40, 60)),
        ({"FrameTime": -3, "RecommendedDisplayFrameRate": 10}, (0, 100, 200, 300)),
    ],
)
def test_frame_times(make_xa: MakeXa, attributes: dict[str, Any], times: tuple[float, ...]) -> None:
    found = facts(make_xa, **attributes)
    assert found.frame_times_ms == pytest.approx(times)
    assert found.frame_time_ms == pytest.approx(times[-1] / 3)
    assert found.warnings == ()


def test_no_frame_rate_at_all(make_xa: MakeXa) -> None:
    assert facts(make_xa, FrameTime=None).warnings == (HeaderWarning.FRAME_TIME_ASSUMED,)


@pytest.mark.parametrize(
    ("attributes", "acquired"),
    [
        ({}, None),
        ({"AcquisitionDateTime": "20240102030405.5+0200"}, datetime(2024, 1, 2, 1, 4, 5, 500000, UTC)),
        ({"AcquisitionDate": "20240102", "AcquisitionTime": "030405"}, datetime(2024, 1, 2, 3, 4, 5, 0, UTC)),
        (
            {"ContentDate": "20240102", "ContentTime": "030405.25", "TimezoneOffsetFromUTC": "-0400"},
            datetime(2024, 1, 2, 7, 4, 5, 250000, UTC),
        ),
        ({"SeriesDate": "20240102", "SeriesTime": "03"}, datetime(2024, 1, 2, 3, 0, 0, 0, UTC)),
        ({"StudyDate": "20240102", "StudyTime": "030405"}, None),
        ({"AcquisitionDate": "20240102", "SeriesDate": "20240103", "SeriesTime": "1000"}, datetime(2024, 1, 3, 10, tzinfo=UTC)),
    ],
)  # fmt: skip
def test_acquired(make_xa: MakeXa, attributes: dict[str, str], acquired: datetime | None) -> None:
    assert facts(make_xa, **attributes).acquired == acquired


@pytest.mark.parametrize(
    ("attributes", "acquired", "within_s"),
    [
        # The date alone is less exact than date and time.
        ({"AcquisitionDateTime": "20240105", "AcquisitionDate": "20240105", "AcquisitionTime": "101500"}, "2024-01-05 10:15", 1),
        ({"AcquisitionDateTime": "2024", "AcquisitionDate": "20240105", "AcquisitionTime": "1015"}, "2024-01-05 10:15", 60),
        ({"AcquisitionDateTime": "20240105", "AcquisitionTime": "10"}, "2024-01-05 10:00", 3600),
        ({"AcquisitionDateTime": "202401051015", "ContentDate": "20240105", "ContentTime": "101530.25"},
         "2024-01-05 10:15:30.25", 0.01),
        # Another moment does not replace a more direct one, however exact.
        ({"AcquisitionDateTime": "202401051015", "ContentDate": "20240301", "ContentTime": "101530.25"}, "2024-01-05 10:15", 60),
        ({"AcquisitionDate": "20240105", "AcquisitionTime": "101500", "ContentDate": "20240105", "ContentTime": "120000",
          "SeriesDate": "20240105", "SeriesTime": "090000.123"}, "2024-01-05 10:15", 1),
        ({"AcquisitionDate": "20240105"}, "2024-01-05 00:00", 86400),
        ({"AcquisitionDateTime": "202401"}, None, 0),
        ({"AcquisitionTime": "101500"}, None, 0),
        ({"AcquisitionTime": "101500", "StudyDate": "20240105"}, "2024-01-05 10:15", 1),
        # Midnight between the start of the series, the run, and the storing of its content.
        ({"AcquisitionTime": "000100", "SeriesDate": "20240104", "SeriesTime": "235900"}, "2024-01-05 00:01", 1),
        ({"AcquisitionTime": "235959", "ContentDate": "20240105", "ContentTime": "000030"}, "2024-01-04 23:59:59", 1),
        ({"AcquisitionDateTime": "20240105101500.5+0200"}, "2024-01-05 08:15:00.5", 0.1),
        ({"AcquisitionDateTime": "20240105", "AcquisitionTime": "0030", "TimezoneOffsetFromUTC": "+0200"}, "2024-01-04 22:30", 60),
    ],
)  # fmt: skip
def test_start_is_as_exact_as_the_header(
    make_xa: MakeXa, attributes: dict[str, str], acquired: str | None, within_s: float
) -> None:
    found = facts(make_xa, **attributes)
    assert found.acquired == (None if acquired is None else datetime.fromisoformat(f"{acquired}+00:00"))
    assert found.acquired_within_s == pytest.approx(within_s)
    stated = "TimezoneOffsetFromUTC" in attributes or "+" in attributes.get("AcquisitionDateTime", "")
    assert found.acquired_zone_known is stated
    assert InstanceFacts.from_json(found.to_json()) == found


def test_times_and_dates_of_other_forms(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, AcquisitionDate="2024010506", AcquisitionTime="10150000")
    path.write_bytes(path.read_bytes().replace(b"2024010506", b"2024.01.05").replace(b"10150000", b"10:15:00"))
    assert read_instance(path).acquired == datetime(2024, 1, 5, 10, 15, tzinfo=UTC)


def test_impossible_date(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, AcquisitionDateTime="20240102030405")
    path.write_bytes(path.read_bytes().replace(b"20240102030405", b"20241399030405"))
    assert read_instance(path).acquired is None


def test_unreadable_number_is_an_absent_number(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, PositionerPrimaryAngle="12.5", SeriesNumber=4321)
    path.write_bytes(path.read_bytes().replace(b"12.5", b"12,5").replace(b"4321", b"43x1"))
    found = read_instance(path)
    assert (found.primary_deg, found.series_number) == (None, None)


def test_r_waves(make_xa: MakeXa) -> None:
    found = facts(make_xa, RWavePointer=[1, 3, 9])
    assert found.r_wave_frames == (0, 2)
    assert found.warnings == (HeaderWarning.R_WAVES_IGNORED,)


@pytest.mark.parametrize(("relationship", "logarithmic"), [("LIN", False), ("LOG", True), ("DISP", True)])
def test_intensities(make_xa: MakeXa, relationship: str, logarithmic: bool) -> None:
    assert facts(make_xa, PixelIntensityRelationship=relationship).pixels.logarithmic is logarithmic
    assert facts(make_xa, PixelIntensityRelationship=None).warnings == (HeaderWarning.PIXEL_INTENSITY_UNKNOWN,)


def test_bits_stored_that_lies(make_xa: MakeXa) -> None:
    found = read_instance(make_xa(FRAMES + np.uint16(3000), BitsStored=10, HighBit=9))
    assert found.pixels.bits_stored == 12
    assert found.warnings == (HeaderWarning.BITS_STORED_EXCEEDED,)


def test_shutters(make_xa: MakeXa) -> None:
    found = facts(
        make_xa,
        CollimatorShape="RECTANGULAR",
        CollimatorLeftVerticalEdge=1,
        CollimatorRightVerticalEdge=14,
        CollimatorUpperHorizontalEdge=3,
        CollimatorLowerHorizontalEdge=9,
        ShutterShape=["RECTANGULAR", "CIRCULAR", "POLYGONAL"],
        ShutterLeftVerticalEdge=2,
        ShutterRightVerticalEdge=16,
        ShutterUpperHorizontalEdge=1,
        ShutterLowerHorizontalEdge=8,
        CenterOfCircularShutter=[4, 8],
        RadiusOfCircularShutter=5,
        VerticesOfThePolygonalShutter=[1, 1, 1, 16, 8, 16],
    )
    shutter = found.pixels.shutter
    assert shutter is not None
    assert shutter.rectangle == (1, 13, 2, 7)
    assert shutter.circle == (7, 3, 5)
    assert shutter.polygon == ((0, 0), (15, 0), (15, 7))
    assert found.warnings == ()


def test_senseless_shutter(make_xa: MakeXa) -> None:
    found = facts(make_xa, ShutterShape="CIRCULAR", CenterOfCircularShutter=[4, 8])
    assert found.pixels.shutter is None
    assert found.warnings == (HeaderWarning.SHUTTER_IGNORED,)


def test_display_window(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, WindowCenter=100, WindowWidth=101)
    found = read_instance(path)
    frame = open_frames(path, found)[0]
    shown = frame_to_8bit(frame, found)
    assert shown.dtype == np.uint8
    # PS3.3 C.11.2.1.2.1: black up to c - 0.5 - (w-1)/2, white beyond c - 0.5 + (w-1)/2.
    assert shown[frame <= 49].max() == 0
    assert frame_to_8bit(frame, found, (20.5, 2)).max() == 255
    assert (np.diff(shown.ravel().astype(int)) >= 0).all()


@pytest.mark.parametrize(
    ("window", "kept"),
    [
        ((2048, 4096), True), ((60, 20), True), ((4095, 4096), True), ((1000, 10_000), True),
        ((32_768, 65_536), False), ((-500, 1000), False), ((9000, 100), False),
    ],
)  # fmt: skip
def test_a_window_beside_the_possible_values_is_ignored(
    make_xa: MakeXa, window: tuple[float, float], kept: bool
) -> None:
    path = make_xa(FRAMES, BitsStored=12, HighBit=11, WindowCenter=window[0], WindowWidth=window[1])
    found = read_instance(path)
    assert (found.window, found.warnings) == (window if kept else None, () if kept else (HeaderWarning.WINDOW_IGNORED,))
    if not kept:
        shown = frame_to_8bit(open_frames(path, found)[1], found)
        assert (shown.min(), shown.max()) == (0, 255)


def test_the_window_of_an_enhanced_run(make_xa: MakeXa) -> None:
    """Pixels of 12 bits over their whole range: the picture has black, white and greys between."""
    window, groups = Dataset(), Dataset()
    window.WindowCenter, window.WindowWidth = 2048, 4096
    groups.FrameVOILUTSequence = [window]
    frames = np.linspace(0, 4095, FRAMES.size).astype(np.uint16).reshape(FRAMES.shape)
    for shared in ([groups], [Dataset()]):
        path = make_xa(
            frames, SOPClassUID=EnhancedXAImageStorage, BitsStored=12, HighBit=11,
            SharedFunctionalGroupsSequence=shared, PerFrameFunctionalGroupsSequence=[Dataset()] * 4,
        )  # fmt: skip
        found = read_instance(path)
        assert found.window == ((2048, 4096) if shared == [groups] else None)
        pictures = [frame_to_8bit(frame, found) for frame in open_frames(path, found)]
        assert (pictures[0].min(), pictures[3].max()) == (0, 255)
        assert found.window is None or 90 < np.mean(pictures) < 165


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian, ExplicitVRBigEndian])
@pytest.mark.parametrize("bits", [(12,), (12, 15), (14,)])
def test_overlay_planes_in_pixel_cells_are_no_pixels(make_xa: MakeXa, syntax: str, bits: tuple[int, ...]) -> None:
    plain = make_xa(FRAMES, BitsStored=12, HighBit=11, syntax=syntax)
    facts = read_instance(plain)
    picture = frame_png(plain, facts, 1, None)
    planes = np.random.default_rng(1).integers(0, 2, (len(bits), *FRAMES.shape), np.uint16)
    cells = FRAMES + sum(plane << bit for bit, plane in zip(bits, planes, strict=True))
    overlay = {}
    for number, bit in enumerate(bits):
        group = 0x6000 + 2 * number
        overlay |= {Tag(group, 0x0010): ("US", 8), Tag(group, 0x0100): ("US", 16), Tag(group, 0x0102): ("US", bit)}
    path = make_xa(cells.astype(np.uint16), BitsStored=12, HighBit=11, syntax=syntax, elements=overlay)
    found = read_instance(path)
    assert (found.warnings, found.pixels) == ((), facts.pixels)
    assert frame_png(path, found, 1, None) == picture
    np.testing.assert_array_equal(np.stack(list(open_frames(path, found))), FRAMES)
    # The header that goes with the raw frame names the planes.
    assert frame_bytes(path, found, 1) == cells[1].astype("<u2").tobytes()


def test_bits_that_no_overlay_names_are_pixels(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES + 4096, BitsStored=12, HighBit=11, elements={Tag(0x6000, 0x0102): ("US", 14)})
    found = read_instance(path)
    assert found.warnings == (HeaderWarning.BITS_STORED_EXCEEDED,)
    np.testing.assert_array_equal(open_frames(path, found)[0], FRAMES[0] + 4096)


def test_display_without_window_uses_the_whole_range(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES)
    shown = frame_to_8bit(open_frames(path, read_instance(path))[1], read_instance(path))
    assert (shown.min(), shown.max()) == (0, 255)
    flat = frame_to_8bit(np.full((4, 4), 7, np.uint16), read_instance(path))
    assert len(np.unique(flat)) == 1


def test_monochrome1_is_inverted_for_display_only(make_xa: MakeXa) -> None:
    path = make_xa(FRAMES, PhotometricInterpretation="MONOCHROME1")
    found = read_instance(path)
    frame = open_frames(path, found)[0]
    np.testing.assert_array_equal(frame, FRAMES[0])
    shown = frame_to_8bit(frame, found)
    assert found.pixels.monochrome1
    assert shown[0, 0] == 255
    assert shown[-1, -1] == 0


def test_every_warning_has_its_sentence() -> None:
    assert all(warning.sentence.endswith(".") for warning in HeaderWarning)
