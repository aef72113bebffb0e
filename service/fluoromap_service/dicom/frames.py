"""The frames of a stored run, decoded frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.uid import DeflatedExplicitVRLittleEndian

from fluoromap.drawing.png import encode_png
from fluoromap_service.dicom.codestream import Pixels, decode, largest_codestream
from fluoromap_service.dicom.errors import DicomCode, dicom_problem
from fluoromap_service.dicom.facts import InstanceFacts, Pair
from fluoromap_service.dicom.header import read_header, truncation_problem
from fluoromap_service.dicom.inflation import open_dicom
from fluoromap_service.dicom.pixel_layout import NATIVE, PixelLayout, pixel_layout


class DicomFrames:
    """A :class:`fluoromap.contracts.FrameSource` over one file.

    It knows the place of each frame in the file, and decodes a frame when it is asked for. It keeps no file open, so that it
    can go to another thread or process. A deflated file is inflated once for an iteration, and for each single frame.
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
        """Return the stored pixels of frame ``index`` (from 0), (rows, columns) uint8 or uint16.

        Raises
        ------
        IndexError
        Problem
            ``undecodable`` or ``pixel_data_mismatch`` for a damaged frame.
        """
        return _pixels(self.cells(index), self._layout)

    def cells(self, index: int) -> Pixels:
        """Return the pixel cells of a frame: its pixels with embedded overlay planes."""
        if not 0 <= index < len(self):
            raise IndexError(f"the run has {len(self)} frames")
        with self._opened() as file:
            return _read_cells(file, self._layout, index)

    def __iter__(self) -> Iterator[Pixels]:
        with self._opened() as file:
            for index in range(len(self)):
                yield read_frame(file, self._layout, index)

    def _opened(self) -> AbstractContextManager[BufferedReader]:
        # The layout knows the transfer syntax. To read it again takes longer than to read a frame.
        is_deflated = self._layout.transfer_syntax == DeflatedExplicitVRLittleEndian
        return open_dicom(self._path) if is_deflated else self._path.open("rb")


def open_frames(path: Path, facts: InstanceFacts) -> DicomFrames:
    """Return the frames of a file with these facts.

    Raises
    ------
    Problem
        ``pixel_data_mismatch`` when the file no longer fits the facts.
    """
    with open_dicom(path) as file:
        layout = pixel_layout(file, read_header(file), [])
    if (layout.frames, layout.rows, layout.columns) != (facts.frames, facts.rows, facts.columns):
        raise dicom_problem(
            DicomCode.PIXEL_DATA_MISMATCH,
            "The stored file has changed since its upload; restore it from a backup.",
            "PixelData",
        )
    return DicomFrames(path, layout)


def read_frame(file: BufferedReader, layout: PixelLayout, index: int) -> Pixels:
    """Return the stored pixels of one frame of an open file."""
    return _pixels(_read_cells(file, layout, index), layout)


def _pixels(cells: Pixels, layout: PixelLayout) -> Pixels:
    """Return pixel cells without overlay planes; changes them in place."""
    if layout.overlay_bits:
        cells &= np.array(~layout.overlay_bits & (1 << layout.bits_allocated) - 1, cells.dtype)
    return cells


def _read_cells(file: BufferedReader, layout: PixelLayout, index: int) -> Pixels:
    if layout.transfer_syntax in NATIVE:
        if layout.big_endian_words:
            return _read_big_endian(file, layout, index)
        pixels: Pixels = np.empty((layout.rows, layout.columns), dtype=f"<u{layout.bits_allocated // 8}")
        ((offset, _),) = layout.extents[index]
        file.seek(offset)
        if file.readinto(pixels.data) != pixels.nbytes:
            raise truncation_problem("PixelData")
        return pixels
    extents = layout.extents[index]
    if sum(length for _, length in extents) > largest_codestream(layout):
        raise dicom_problem(
            DicomCode.PIXEL_DATA_MISMATCH,
            "A compressed frame is larger than its pixels; export the run again.",
            "PixelData",
        )
    pieces = []
    for offset, length in extents:
        file.seek(offset)
        pieces.append(file.read(length))
    return decode(layout, b"".join(pieces))


def _read_big_endian(file: BufferedReader, layout: PixelLayout, index: int) -> Pixels:
    ((offset, length),) = layout.extents[index]
    # A frame with an odd number of bytes begins or ends within a word.
    before = offset % 2
    whole_words = before + length + (before + length) % 2
    file.seek(offset - before)
    content = file.read(whole_words)
    if len(content) < whole_words:
        raise truncation_problem("PixelData")
    data = np.frombuffer(content, dtype="<u2").byteswap().view(np.uint8)[before : before + length]
    pixels: Pixels = data.view(f"<u{layout.bits_allocated // 8}").reshape(layout.rows, layout.columns)
    return pixels


def frame_to_8bit(pixels: Pixels, facts: InstanceFacts, window: Pair | None = None) -> NDArray[np.uint8]:
    """Return a frame for display, (rows, columns) uint8, in the stored orientation.

    0 is black and 255 is white; catheters are dark.

    Parameters
    ----------
    pixels : (rows, columns)
        Stored pixels.
    window : tuple of float, optional
        (centre, width) in stored values, the linear function of PS3.3 C.11.2.1.2.1. By default the file's own window,
        otherwise the frame's 0.5th to 99.5th percentile.
    """
    chosen = window or facts.window
    if chosen is None:
        low, high = _range(pixels)
    else:
        centre, width = chosen
        low = centre - 0.5 - (width - 1) / 2
        high = low + width - 1
    # The grey of each value that occurs, looked up for each pixel, is several times as fast as arithmetic with pixels.
    values = np.arange(int(pixels.max()) + 1, dtype=np.float32)
    shown = np.clip(np.rint((values - low) * (255.0 / max(high - low, 1e-3))), 0, 255)
    greys: NDArray[np.uint8] = (255 - shown if facts.pixels.monochrome1 else shown).astype(np.uint8)
    display: NDArray[np.uint8] = greys[pixels]
    return display


def _range(pixels: Pixels) -> Pair:
    """Return the 0.5th and the 99.5th percentile of the pixels, between two values linearly."""
    up_to = np.cumsum(np.bincount(pixels.ravel()))
    places = np.array([0.005, 0.995]) * (pixels.size - 1)
    below, above = (np.searchsorted(up_to, side(places), side="right") for side in (np.floor, np.ceil))
    low, high = (below + (above - below) * (places % 1)).tolist()
    return low, high


def cine_8bit(path: Path, facts: InstanceFacts, first: int, count: int) -> bytes:
    """Return ``count`` frames from frame ``first`` (from 0) on for display, one byte a pixel.

    All frames have one window, so that the picture does not flicker: the file's own, else the range of the run's first frame.
    """
    frames = open_frames(path, facts)
    chosen = facts.window
    if chosen is None:
        low, high = _range(frames[0])
        chosen = ((low + high + 1) / 2, max(high - low, 1.0) + 1)
    return b"".join(frame_to_8bit(frames[first + k], facts, chosen).tobytes() for k in range(count))


def frame_png(path: Path, facts: InstanceFacts, frame: int, window: Pair | None) -> bytes:
    """Return frame ``frame`` (from 0) of a file as a greyscale PNG; ``window`` as in :func:`frame_to_8bit`."""
    return encode_png(frame_to_8bit(open_frames(path, facts)[frame], facts, window))


def frame_bytes(path: Path, facts: InstanceFacts, frame: int) -> bytes:
    """Return the pixel cells of one frame as bytes, as the header describes them.

    ``frame`` counts from 0. The bytes are row by row, little endian. Overlay planes stay: OverlayBitPosition is in the header.
    """
    return open_frames(path, facts).cells(frame).tobytes()
