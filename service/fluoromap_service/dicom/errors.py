"""The problems of DICOM files: a closed list of codes, each with its HTTP status."""

from __future__ import annotations

from enum import StrEnum

from fluoromap_service.problem import Problem


class DicomCode(StrEnum):
    """Stable codes of the problems of DICOM files.

    The status shows what to change: 400 and 413 the transfer or the archive, 415 the choice of the file, 422 the export
    settings of the modality.
    """

    NOT_DICOM = "not_dicom"
    """No DICOM file at all (415)."""
    NO_PART10_HEADER = "no_part10_header"
    """A bare data set: the preamble and file meta information of PS3.10 section 7.1 are missing (415)."""
    MALFORMED = "malformed"
    """The header is damaged, or lacks an attribute that every object has (400)."""
    TRUNCATED = "truncated"
    """The file ends before its announced end (400)."""
    PIXEL_DATA_MISMATCH = "pixel_data_mismatch"
    """Pixel data is whole but contradicts NumberOfFrames, Rows, Columns or BitsAllocated (400)."""
    HEADER_TOO_LARGE = "header_too_large"
    """The attributes before the pixel data, or an inflated data set, exceed every sensible size (413)."""
    FRAME_TOO_LARGE = "frame_too_large"
    """Rows or Columns exceed 8192 (413)."""
    TOO_MANY_FRAMES = "too_many_frames"
    """NumberOfFrames exceeds 20000 (413)."""
    NOT_XA = "not_xa"
    """DICOM, but not an X-ray angiographic or radiofluoroscopic image (422)."""
    NO_PIXEL_DATA = "no_pixel_data"
    """An object of the right kind without an image in it (422)."""
    UNSUPPORTED_PIXELS = "unsupported_pixels"
    """Colour, signed or otherwise unusual pixels (422)."""
    UNDECODABLE = "undecodable"
    """A transfer syntax that this service cannot decode, or a frame that does not decode (422)."""

    @property
    def status(self) -> int:
        """HTTP status of the problem."""
        return _STATUS[self]


_STATUS: dict[DicomCode, int] = {
    DicomCode.NOT_DICOM: 415,
    DicomCode.NO_PART10_HEADER: 415,
    DicomCode.MALFORMED: 400,
    DicomCode.TRUNCATED: 400,
    DicomCode.PIXEL_DATA_MISMATCH: 400,
    DicomCode.HEADER_TOO_LARGE: 413,
    DicomCode.FRAME_TOO_LARGE: 413,
    DicomCode.TOO_MANY_FRAMES: 413,
    DicomCode.NOT_XA: 422,
    DicomCode.NO_PIXEL_DATA: 422,
    DicomCode.UNSUPPORTED_PIXELS: 422,
    DicomCode.UNDECODABLE: 422,
}


def dicom_problem(code: DicomCode, message: str, where: str | None = None) -> Problem:
    """Return the problem of a DICOM file that the service cannot use.

    Parameters
    ----------
    code : DicomCode
        Stable code; its ``status`` is the HTTP status.
    message : str
        One sentence for a PACS engineer: what is wrong and what to do. It contains no file name and no value that could
        identify a patient.
    where : str, optional
        The DICOM keyword at fault.
    """
    return Problem(code.status, code, message, [] if where is None else [(where, message)])
