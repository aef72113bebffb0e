"""The frames of a stored run, decoded one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fluoromap_service.dicom.codestream import Pixels, decode, largest_codestream
from fluoromap_service.dicom.errors import DicomCode, dicom_problem
from fluoromap_service.dicom.facts import InstanceFacts, Pair
from fluoromap_service.dicom.header import read_header, truncated
from fluoromap_service.dicom.pixel_layout import NATIVE, PixelLayout, pixel_layout


class DicomFrames:
    """A :class:`fluoromap.contracts.FrameSource` over one file; holds where each frame lies, never more than one frame.

    It keeps no file open: it can be passed to another thread or process.
    """

    def __init__(self, path: Path, layout: PixelLayout) -> None:
        self._path = path
        self._layout = layout

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self._layout.rows, self._layout.columns

    def __len__(self) -> int:
        return self._layout.frames

    def __getitem__(self, index: int) -> Pixels:
        """Stored pixels of frame ``index`` (from 0), shape (rows, columns), uint8 or uint16.

        Raises
        ------
        IndexError
        Problem
            ``undecodable`` or ``pixel_data_mismatch`` for a frame that is broken inside.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"the run has {len(self)} frames")
        with self._path.open("rb") as file:
            return read_frame(file, self._layout, index)

    def __iter__(self) -> Iterator[Pixels]:
        with self._path.open("rb") as file:
            for index in range(len(self)):
                yield read_frame(file, self._layout, index)


def open_frames(path: Path, facts: InstanceFacts) -> DicomFrames:
    """The frames of the file whose facts these are.

    Raises
    ------
    Problem
        When the file is no longer what it was when ``facts`` were read.
    """
    with path.open("rb") as file:
        layout = pixel_layout(file, read_header(file), [])
    if (layout.frames, layout.rows, layout.columns) != (facts.frames, facts.rows, facts.columns):
        raise dicom_problem(DicomCode.PIXEL_DATA_MISMATCH, "The file changed since it was received.", "PixelData")
    return DicomFrames(path, layout)


def read_frame(file: BufferedReader, layout: PixelLayout, index: int) -> Pixels:
    """Stored pixels of one frame from an open file."""
    if layout.transfer_syntax in NATIVE:
        pixels: Pixels = np.empty((layout.rows, layout.columns), dtype=f"<u{layout.bits_allocated // 8}")
        ((offset, _),) = layout.extents[index]
        file.seek(offset)
        if file.readinto(pixels.data) != pixels.nbytes:
            raise truncated("PixelData")
        return pixels
    extents = layout.extents[index]
    if sum(length for _, length in extents) > largest_codestream(layout):
        raise dicom_problem(DicomCode.PIXEL_DATA_MISMATCH, "A compressed frame is larger than its pixels.", "PixelData")
    pieces = []
    for offset, length in extents:
        file.seek(offset)
        pieces.append(file.read(length))
    return decode(layout, b"".join(pieces))


def frame_to_8bit(pixels: Pixels, facts: InstanceFacts, window: Pair | None = None) -> NDArray[np.uint8]:
    """A frame for display: 0 black, 255 white, dark catheters dark, in the stored orientation.

    Parameters
    ----------
    pixels : (rows, columns)
        Stored pixels.
    window : tuple of float, optional
        (centre, width) in stored values, the linear function of PS3.3 C.11.2.1.2.1. Without it the file's own window,
        else the frame's 0.5th to 99.5th percentile.
    """
    chosen = window or facts.window
    if chosen is None:
        low, high = (float(value) for value in np.percentile(pixels.astype(np.float32), (0.5, 99.5)))
    else:
        centre, width = chosen
        low = centre - 0.5 - (width - 1) / 2
        high = low + width - 1
    scaled = (pixels.astype(np.float32) - low) * (255.0 / max(high - low, 1e-3))
    shown = np.clip(np.rint(scaled), 0, 255)
    display: NDArray[np.uint8] = (255 - shown if facts.pixels.monochrome1 else shown).astype(np.uint8)
    return display
