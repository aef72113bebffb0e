"""Real XA and RF files (FLUOROMAP_SAMPLE_DATA): what real headers lack, and decoders that must agree."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pydicom
import pytest
from pydicom.pixels.utils import pixel_array

from fluoromap_service.dicom import DicomCode, HeaderWarning, open_frames, read_instance
from fluoromap_service.dicom.deidentification.pseudonyms import Dates, Pseudonyms
from fluoromap_service.dicom.deidentification.run_file import deidentify_file
from fluoromap_service.dicom.facts import TableOrigin
from fluoromap_service.problem import Problem

Sample = Callable[[str], Path]


def test_real_cine(sample: Sample) -> None:
    path = sample("xa_512x512x96_jpeg_baseline.dcm")
    facts = read_instance(path)
    assert (facts.frames, facts.rows, facts.columns) == (96, 512, 512)
    assert (facts.primary_deg, facts.secondary_deg) == (-32, 2)
    assert facts.missing == ("DistanceSourceToDetector", "DistanceSourceToPatient", "ImagerPixelSpacing")
    assert facts.r_wave_frames == (19, 52, 76)
    assert facts.frame_time_ms == 33
    assert not facts.pixels.logarithmic
    assert facts.warnings == ()
    frames = open_frames(path, facts)
    for index in (0, 40, 95):
        expected = pixel_array(path, index=index, decoding_plugin="pillow")
        # Two JPEG decoders may round differently.
        assert np.abs(frames[index].astype(int) - expected).max() <= 3


def test_real_cine_cut_short(sample: Sample, tmp_path: Path) -> None:
    content = sample("xa_512x512x96_jpeg_baseline.dcm").read_bytes()
    path = tmp_path / "cut.dcm"
    for length in (len(content) - 1, len(content) // 2, 5000, 300):
        path.write_bytes(content[:length])
        with pytest.raises(Problem) as caught:
            read_instance(path)
        assert caught.value.code is DicomCode.TRUNCATED


def test_lossless_pair_is_identical(sample: Sample) -> None:
    paths = [sample("xa_1024_jpeg_lossless.dcm"), sample("xa_1024_jpeg2000_lossless.dcm")]
    first, second = (open_frames(path, read_instance(path))[0] for path in paths)
    assert first.shape == (1024, 1024)
    assert first.dtype == np.uint16
    np.testing.assert_array_equal(first, second)


def test_twelve_bit_jpeg_is_refused(sample: Sample) -> None:
    with pytest.raises(Problem, match="JPEG Extended") as caught:
        read_instance(sample("xa_1024_jpeg_extended_12bit.dcm"))
    assert (caught.value.code, caught.value.status) == (DicomCode.UNDECODABLE, 422)


def test_radiofluoroscopy_shutter(sample: Sample) -> None:
    facts = read_instance(sample("rf_1024_shutter.dcm"))
    assert facts.pixels.shutter is not None
    assert facts.pixels.shutter.circle == (479, 479, 470)
    assert facts.pixels.shutter.rectangle == (9, 949, 9, 949)
    assert facts.pixels.shutter.polygon is None
    assert facts.window == (127, 255)


def test_table_positions_of_a_real_c_arm_in_its_private_block(sample: Sample) -> None:
    runs = [read_instance(sample(f"real_c_arm/ge_phantom_im{number}.dcm")) for number in range(1, 9)]
    assert {run.table_origin for run in runs} == {TableOrigin.GE}
    assert [run.table_mm for run in runs] == [
        *[(9.2, 84.0, 503.9)] * 4, (9.2, 66.3, 503.9), (7.7, 55.1, 470.2), (-7.5, 55.1, 510.0), (29.6, 55.1, 522.3),
    ]  # fmt: skip


def test_geometry_of_a_real_c_arm(sample: Sample) -> None:
    """GE writes DRM for its cine, empty PatientOrientation, and trailing zeros in its angles."""
    runs = [read_instance(sample(f"real_c_arm/ge_phantom_im{number}.dcm")) for number in range(1, 9)]
    assert [(run.primary_deg, run.secondary_deg) for run in runs] == [
        (31.3, 0.1), (-27.3, -0.1), (-0.8, -23.2), (0.1, 28.7), (-26.5, -32.7), (24, -18.8), (-29.3, 25.5), (30.7, 23.6),
    ]  # fmt: skip
    assert {run.source_isocentre_mm for run in runs} == {720}
    assert all(run.pixels.logarithmic and not run.missing for run in runs)
    assert {run.image_axes for run in runs} == {((1, 0), (0, 1))}
    assert {run.plane for run in runs} == {"single"}
    moved = {HeaderWarning.POSITIONER_MOVED, HeaderWarning.TABLE_MOVED}
    assert not any(moved & set(run.warnings) for run in runs)


@pytest.mark.parametrize(
    "name",
    ["real_c_arm/ge_phantom_im5.dcm", "xa_512x512x96_jpeg_baseline.dcm", "rf_1024_shutter.dcm",
     "xa_1024_jpeg2000_lossless.dcm"],
)  # fmt: skip
def test_deidentified_copies_of_real_files(sample: Sample, tmp_path: Path, name: str) -> None:
    source, target = sample(name), tmp_path / "copy.dcm"
    replaced = deidentify_file(source, target, Pseudonyms(b"secret", "patient", "S-1", Dates.SHIFT))
    expected, found = read_instance(source), read_instance(target)
    assert found.sop_instance_uid == replaced[expected.sop_instance_uid]
    assert (found.table_mm, found.primary_deg, found.missing) == (
        expected.table_mm,
        expected.primary_deg,
        expected.missing,
    )
    assert np.array_equal(open_frames(source, expected)[0], open_frames(target, found)[0])
    content = target.read_bytes()
    assert not any(uid.encode() in content for uid in replaced)
    header = pydicom.dcmread(source, stop_before_pixels=True)
    for keyword in ("InstitutionName", "StationName", "AccessionNumber", "DeviceSerialNumber", "PatientBirthDate"):
        if header.get(keyword) and len(str(header[keyword].value)) > 3:
            assert str(header[keyword].value).encode() not in content
