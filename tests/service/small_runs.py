"""Small cine runs for tests of the doors: real DICOM files with a picture of noise."""

from __future__ import annotations

import io
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pydicom

from fluoromap.geometry import Gantry
from fluoromap_service.dicom import deterministic_uid, write_cine

ROWS, COLUMNS, FRAMES = 48, 64, 3
START = datetime(2026, 3, 1, 9, 30, tzinfo=UTC)
STUDY_UID = deterministic_uid("tests", "study")


def run_uid(number: int) -> str:
    return deterministic_uid("tests", "run", str(number))


def small_run(
    folder: Path, number: int, primary_deg: float, *, secondary_deg: float = 0.0, seconds: float | None = None
) -> bytes:
    """Return the DICOM file of run ``number``.

    It begins ``seconds`` after the first one, by default 20 s for each number.
    """
    pixels = np.random.default_rng(number).integers(0, 4096, (FRAMES, ROWS, COLUMNS)).astype(np.uint16)
    path = folder / f"small{number}.dcm"
    write_cine(
        path,
        iter(pixels),
        frame_count=FRAMES,
        gantry=Gantry(primary_deg, secondary_deg, 1000.0, 750.0, (0.3, 0.3), ROWS, COLUMNS),
        frame_time_ms=16.7,
        acquired=START + timedelta(seconds=20.0 * number if seconds is None else seconds),
        study_instance_uid=STUDY_UID,
        series_number=number,
        sop_instance_uid=run_uid(number),
    )
    content = path.read_bytes()
    path.unlink()
    return content


def edited(content: bytes, **attributes: Any) -> bytes:
    """Return the file with other attributes; None removes one."""
    dataset = pydicom.dcmread(io.BytesIO(content))
    for keyword, value in attributes.items():
        if value is not None:
            setattr(dataset, keyword, value)
        elif keyword in dataset:
            delattr(dataset, keyword)
    stream = io.BytesIO()
    pydicom.dcmwrite(stream, dataset, enforce_file_format=True)
    return stream.getvalue()
