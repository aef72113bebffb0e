"""Small DICOM files made for each test, and the real ones where they exist."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.tag import BaseTag
from pydicom.uid import ExplicitVRBigEndian, ExplicitVRLittleEndian, XRayAngiographicImageStorage

from fluoromap.geometry import Gantry
from fluoromap_service.dicom import write_cine

MakeXa = Callable[..., Path]
ACQUIRED = datetime(2024, 5, 6, 7, 8, 9, 250000, tzinfo=UTC)


@pytest.fixture
def sample() -> Callable[[str], Path]:
    """Path of a real file; skips where there are none."""

    def find(name: str) -> Path:
        folder = os.environ.get("FLUOROMAP_SAMPLE_DATA")
        if not folder:
            pytest.skip("FLUOROMAP_SAMPLE_DATA does not name a folder of real XA files")
        path = Path(folder) / name
        if not path.exists():
            pytest.skip(f"{name} is not in FLUOROMAP_SAMPLE_DATA")
        return path

    return find


@pytest.fixture
def gantry() -> Gantry:
    return Gantry(-32.5, 12.0, 1000.0, 750.0, (0.4, 0.4), rows=24, columns=32)


@pytest.fixture
def pixels() -> NDArray[np.uint16]:
    """Five frames of 12-bit noise."""
    return np.random.default_rng(1).integers(0, 4096, (5, 24, 32), dtype=np.uint16)


@pytest.fixture
def cine(tmp_path: Path, gantry: Gantry, pixels: NDArray[np.uint16]) -> Path:
    """A whole run of five frames as :func:`write_cine` writes it."""
    path = tmp_path / "cine.dcm"
    write_cine(
        path,
        iter(pixels),
        frame_count=len(pixels),
        gantry=gantry,
        frame_time_ms=1000 / 60,
        acquired=ACQUIRED,
        study_instance_uid="2.25.1",
        series_number=7,
        sop_instance_uid="2.25.2",
        r_wave_frames=(0, 3),
    )
    return path


@pytest.fixture
def make_xa(tmp_path: Path) -> MakeXa:
    """Writes an XA object with given attributes; an attribute set to None is left out."""

    def make(
        frames: NDArray[Any] | None = None,
        *,
        syntax: str = ExplicitVRLittleEndian,
        fragments: list[bytes] | None = None,
        offset_table: bool = False,
        elements: Mapping[BaseTag, tuple[str, Any]] | None = None,
        **attributes: Any,
    ) -> Path:
        dataset = Dataset()
        dataset.SOPClassUID = XRayAngiographicImageStorage
        dataset.SOPInstanceUID, dataset.StudyInstanceUID, dataset.SeriesInstanceUID = "2.25.11", "2.25.12", "2.25.13"
        dataset.Modality = "XA"
        dataset.PatientName = "SECRET^PATIENT"
        dataset.PixelIntensityRelationship = "LIN"
        dataset.SamplesPerPixel, dataset.PhotometricInterpretation = 1, "MONOCHROME2"
        dataset.PixelRepresentation = 0
        if frames is not None:
            dataset.NumberOfFrames, dataset.Rows, dataset.Columns = frames.shape
            bits = frames.dtype.itemsize * 8
            dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = bits, bits, bits - 1
            dataset.FrameTime = 40
            if fragments is None:
                value = frames.tobytes() + b"\0" * (frames.nbytes % 2)
                if syntax == ExplicitVRBigEndian:
                    # pydicom writes words as they are given.
                    value = np.frombuffer(value, "<u2").byteswap().tobytes()
                dataset.add_new(0x7FE00010, "OW", value)
            else:
                dataset.PixelData = encapsulate(fragments, has_bot=offset_table)
                dataset["PixelData"].is_undefined_length = True
                dataset["PixelData"].VR = "OB"
        for keyword, value in attributes.items():
            if value is None:
                delattr(dataset, keyword)
            else:
                setattr(dataset, keyword, value)
        for tag, (representation, value) in (elements or {}).items():
            dataset.add_new(tag, representation, value)
        dataset.file_meta = FileMetaDataset()
        dataset.file_meta.TransferSyntaxUID = pydicom.uid.UID(syntax)
        path = tmp_path / "made.dcm"
        pydicom.dcmwrite(path, dataset, enforce_file_format=True)
        return path

    return make


@pytest.fixture
def raw_items() -> Callable[..., bytes]:
    """Items of encapsulated pixel data, byte by byte: the offset table first, the delimiter last."""

    def build(*values: bytes, delimited: bool = True) -> bytes:
        items = b"".join(struct.pack("<HHL", 0xFFFE, 0xE000, len(value)) + value for value in values)
        return items + (struct.pack("<HHL", 0xFFFE, 0xE0DD, 0) if delimited else b"")

    return build
