"""The header of a stored file as JSON: all attributes, no pixels."""

from __future__ import annotations

import json
from pathlib import Path

import pydicom
import pytest
from pydicom.dataset import Dataset

from fluoromap_service.dicom.json_model import LARGEST_VALUE_BYTES, header_json


@pytest.mark.parametrize(("side_px", "is_kept"), [(64, True), (65, False)])
def test_an_icon_has_no_long_pixel_data(cine: Path, side_px: int, is_kept: bool) -> None:
    dataset = pydicom.dcmread(cine)
    icon = Dataset()
    icon.Rows = icon.Columns = side_px
    icon.BitsAllocated = 8
    icon.add_new("PixelData", "OB", bytes(side_px * side_px + side_px % 2))
    dataset.IconImageSequence = [icon]
    dataset.save_as(cine)
    header = header_json(cine)
    (shown,) = header["00880200"]["Value"]
    assert shown["00280010"]["Value"] == [side_px]
    assert ("7FE00010" in shown) is is_kept
    assert "7FE00010" not in header
    assert len(json.dumps(header)) < 3 * LARGEST_VALUE_BYTES
