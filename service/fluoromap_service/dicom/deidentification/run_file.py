"""The de-identified copy of a run's file; the pixels are copied as they are."""

from __future__ import annotations

import struct
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

from pydicom.dataset import FileMetaDataset
from pydicom.filewriter import dcmwrite
from pydicom.uid import (
    UID,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
)

from fluoromap_service.dicom.deidentification.dataset import deidentify
from fluoromap_service.dicom.deidentification.pseudonyms import Pseudonyms
from fluoromap_service.dicom.header import read_attributes, truncation_problem
from fluoromap_service.dicom.inflation import open_dicom
from fluoromap_service.dicom.repair import repair

_PIXEL_DATA = (0x7FE0, 0x0010)
_ITEM, _DELIMITER = (0xFFFE, 0xE000), (0xFFFE, 0xE0DD)
_UNDEFINED_LENGTH = 0xFFFFFFFF
_CHUNK_BYTES = 2**20


def deidentify_file(source: Path, target: Path, pseudonyms: Pseudonyms) -> dict[str, str]:
    """Write a de-identified copy of a run.

    Memory does not grow with the number of frames. Attributes after the pixel data, such as digital signatures, are left
    out. A deflated file becomes Explicit VR Little Endian.

    Returns
    -------
    dict of str
        The new UIDs by the original ones.
    """
    with open_dicom(source) as file, target.open("wb") as copy:
        syntax, dataset = read_attributes(file)
        start = file.tell()
        repair(dataset)
        uids = deidentify(dataset, pseudonyms)
        dataset.file_meta = FileMetaDataset()
        dataset.file_meta.TransferSyntaxUID = (
            ExplicitVRLittleEndian if syntax == DeflatedExplicitVRLittleEndian else UID(syntax)
        )
        dataset.preamble = bytes(128)
        dcmwrite(copy, dataset, enforce_file_format=True)
        file.seek(start)
        _copy_pixels(file, copy, "big" if syntax == ExplicitVRBigEndian else "little", syntax == ImplicitVRLittleEndian)
    return uids


def _copy_pixels(file: BufferedReader, copy: BinaryIO, order: str, implicit: bool) -> None:
    """Copy the element PixelData (PS3.5 section 7.1, annex A.4)."""
    endian = ">" if order == "big" else "<"
    head = _read(file, 8 if implicit else 12)
    if struct.unpack(f"{endian}HH", head[:4]) != _PIXEL_DATA:
        raise truncation_problem("PixelData")
    copy.write(head)
    (length,) = struct.unpack(f"{endian}L", head[-4:])
    if length != _UNDEFINED_LENGTH:
        _copy(file, copy, length)
        return
    while True:
        item = _read(file, 8)
        group, element, length = struct.unpack("<HHL", item)
        copy.write(item)
        if (group, element) == _DELIMITER:
            return
        if (group, element) != _ITEM:
            raise truncation_problem("PixelData")
        _copy(file, copy, length)


def _copy(file: BufferedReader, copy: BinaryIO, count: int) -> None:
    while count:
        piece = _read(file, min(count, _CHUNK_BYTES))
        copy.write(piece)
        count -= len(piece)


def _read(file: BufferedReader, count: int) -> bytes:
    content = file.read(count)
    if len(content) < count:
        raise truncation_problem("PixelData")
    return content
