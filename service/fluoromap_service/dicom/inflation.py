"""DICOM files for reading: a deflated data set is inflated into a temporary file first."""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import IO, cast

from pydicom.uid import DeflatedExplicitVRLittleEndian

from fluoromap_service.dicom.errors import DicomCode, dicom_problem
from fluoromap_service.dicom.header import data_set_start, truncation_problem

LARGEST_GROWTH = 200
"""Largest ratio of inflated to deflated bytes; real runs reach about 10."""
SMALL_BYTES = 16 * 2**20
"""Size up to which the ratio does not matter."""
_CHUNK_BYTES = 2**18


@contextmanager
def open_dicom(path: Path) -> Iterator[BufferedReader]:
    """Open a DICOM file for reading and seeking.

    Of a file with a deflated data set (PS3.5 section A.5) a copy with the inflated data set is opened. The copy has no name
    and is gone after the reading.

    Raises
    ------
    Problem
        ``truncated`` or ``malformed`` for a damaged deflated data set; ``header_too_large`` when it inflates without end.
    OSError
        When the file cannot be opened.
    """
    with path.open("rb") as file:
        syntax, start = data_set_start(file)
        if syntax != DeflatedExplicitVRLittleEndian:
            file.seek(0)
            yield file
            return
        with tempfile.TemporaryFile() as inflated:
            file.seek(0)
            inflated.write(file.read(start))
            _inflate(file, inflated, max(SMALL_BYTES, LARGEST_GROWTH * path.stat().st_size))
            inflated.seek(0)
            yield cast(BufferedReader, inflated)


def have_same_data_set(path: Path, other: Path) -> bool:
    """Return whether two DICOM files have the same data set.

    The bytes after the file meta information and the transfer syntax must be equal.

    Raises
    ------
    Problem
        As :func:`open_dicom`.
    OSError
        When a file cannot be opened.
    """
    with path.open("rb") as file, other.open("rb") as other_file:
        (syntax, start), (other_syntax, other_start) = data_set_start(file), data_set_start(other_file)
        if syntax != other_syntax or path.stat().st_size - start != other.stat().st_size - other_start:
            return False
        file.seek(start)
        other_file.seek(other_start)
        while piece := file.read(_CHUNK_BYTES):
            if piece != other_file.read(_CHUNK_BYTES):
                return False
    return True


def _inflate(source: IO[bytes], target: IO[bytes], most_bytes: int) -> None:
    """Write the inflated rest of a file (RFC 1951) into another file."""
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    written, piece = 0, b""
    data = source.read(_CHUNK_BYTES)
    try:
        # A full piece may leave bytes in the inflater after the last one was read.
        while not inflater.eof and (data or len(piece) == _CHUNK_BYTES):
            piece = inflater.decompress(data, _CHUNK_BYTES)
            written += target.write(piece)
            if written > most_bytes:
                message = "The deflated data set inflates far beyond its size; send the run uncompressed."
                raise dicom_problem(DicomCode.HEADER_TOO_LARGE, message, "TransferSyntaxUID")
            data = inflater.unconsumed_tail or source.read(_CHUNK_BYTES)
    except zlib.error:
        message = "The deflated data set is damaged; export the run again."
        raise dicom_problem(DicomCode.MALFORMED, message, "TransferSyntaxUID") from None
    if not inflater.eof:
        raise truncation_problem()
