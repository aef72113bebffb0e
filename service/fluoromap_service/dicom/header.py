"""The attributes before the pixel data, read in bounded memory and with a check of every length."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader
from typing import Any, TypeVar, cast

from pydicom import config
from pydicom.charset import convert_encodings
from pydicom.datadict import tag_for_keyword
from pydicom.dataelem import RawDataElement
from pydicom.dataset import Dataset
from pydicom.filereader import data_element_generator, read_dataset
from pydicom.tag import BaseTag, Tag
from pydicom.uid import (
    ExplicitVRBigEndian,
    ImplicitVRLittleEndian,
    MediaStorageDirectoryStorage,
)
from pydicom.valuerep import VR

from fluoromap_service.dicom.errors import DicomCode, dicom_problem
from fluoromap_service.dicom.repair import PATIENT_AND_STUDY, repair
from fluoromap_service.problem import Problem

# pydicom's warnings quote values, and a damaged header may have a person's name in any place.
config.settings.reading_validation_mode = config.IGNORE

HEADER_BYTES = 16 * 2**20
"""Largest header; an Enhanced XA run of 1000 frames has about 2 MB of functional groups."""
HEADER_READS = 250_000
LONGEST_VALUE_BYTES = 2**20
"""Longest value that :func:`read_all_attributes` reads; a longer one is bulk data."""
SEQUENCE_ITEMS = 50_000
UNDEFINED_LENGTH = 0xFFFFFFFF
_ITEM_TAG = {True: b"\xfe\xff\x00\xe0", False: b"\xff\xfe\xe0\x00"}
"""Bytes of the tag that begins an item of a sequence; keys: whether the byte order is little endian."""

Result = TypeVar("Result")

_PIXEL_DATA = 0x7FE00010
_CHARACTER_SET = 0x00080005
_REPRESENTATIONS = frozenset(map(str, VR))
"""The value representations of PS3.5 section 6.2."""
_FRAME_GROUPS = ("SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence")

# Functional group macros of Enhanced XA and RF, PS3.3 C.8.19.6, and the attributes read from each.
MACROS: dict[str, tuple[str, ...]] = {
    "PositionerPositionSequence": ("PositionerPrimaryAngle", "PositionerSecondaryAngle"),
    "XRayGeometrySequence": ("DistanceSourceToDetector", "DistanceSourceToIsocenter"),
    "FramePixelDataPropertiesSequence": (
        "ImagerPixelSpacing", "PixelIntensityRelationship", "PixelIntensityRelationshipSign",
    ),
    "FieldOfViewSequence": (
        "FieldOfViewShape", "FieldOfViewDimensionsInFloat", "FieldOfViewRotation", "FieldOfViewHorizontalFlip",
    ),
    "TablePositionSequence": (
        "TableTopVerticalPosition", "TableTopLongitudinalPosition", "TableTopLateralPosition",
        "TableHorizontalRotationAngle", "TableHeadTiltAngle", "TableCradleTiltAngle",
    ),
    "IsocenterReferenceSystemSequence": (
        "PositionerIsocenterPrimaryAngle", "PositionerIsocenterSecondaryAngle",
        "PositionerIsocenterDetectorRotationAngle", "TableXPositionToIsocenter", "TableYPositionToIsocenter",
        "TableZPositionToIsocenter", "TableHorizontalRotationAngle", "TableHeadTiltAngle", "TableCradleTiltAngle",
    ),
    "CollimatorShapeSequence": (
        "CollimatorShape", "CollimatorLeftVerticalEdge", "CollimatorRightVerticalEdge",
        "CollimatorUpperHorizontalEdge", "CollimatorLowerHorizontalEdge", "CenterOfCircularCollimator",
        "RadiusOfCircularCollimator", "VerticesOfThePolygonalCollimator",
    ),
    "FrameDisplayShutterSequence": (
        "ShutterShape", "ShutterLeftVerticalEdge", "ShutterRightVerticalEdge", "ShutterUpperHorizontalEdge",
        "ShutterLowerHorizontalEdge", "CenterOfCircularShutter", "RadiusOfCircularShutter", "VerticesOfThePolygonalShutter",
    ),
    "FrameVOILUTSequence": ("WindowCenter", "WindowWidth"),
    "FrameContentSequence": ("FrameAcquisitionDateTime", "FrameReferenceDateTime"),
    "PatientOrientationInFrameSequence": ("PatientOrientation",),
}  # fmt: skip
"""The functional groups that the service reads, and the attributes of each."""
_MACROS_OF = {
    keyword: tuple(macro for macro, keywords in MACROS.items() if keyword in keywords)
    for keyword in itertools.chain.from_iterable(MACROS.values())
}

_PLAIN = (
    "ImageType", "SOPClassUID", "SOPInstanceUID", "StudyInstanceUID", "SeriesInstanceUID", "SeriesNumber", "Modality",
    "AcquisitionDateTime", "AcquisitionDate", "AcquisitionTime", "ContentDate", "ContentTime", "SeriesDate", "SeriesTime",
    "TimezoneOffsetFromUTC", "FrameTime", "FrameTimeVector", "FrameIncrementPointer", "CineRate",
    "RecommendedDisplayFrameRate", "PlaneIdentification", "PositionerMotion", "PositionerPrimaryAngleIncrement",
    "PositionerSecondaryAngleIncrement", "DistanceSourceToPatient", "EstimatedRadiographicMagnificationFactor",
    "IntensifierSize", "FieldOfViewDimensions", "TableMotion", "TableVerticalIncrement",
    "TableLateralIncrement", "TableLongitudinalIncrement", "RWavePointer", "SamplesPerPixel", "PhotometricInterpretation",
    "PatientPosition", "PatientOrientationCodeSequence", "PatientGantryRelationshipCodeSequence",
    "TableAngle", "Manufacturer", "ManufacturerModelName",
    "NumberOfFrames", "Rows", "Columns", "BitsAllocated", "BitsStored", "HighBit", "PixelRepresentation",
)  # fmt: skip
_PATIENT_AND_STUDY = ("SpecificCharacterSet", *PATIENT_AND_STUDY)


# GE's table position. The creator's element number 00bb gives its elements the numbers bb00 to bbFF, PS3.5 section 7.8.1.
_PRIVATE_GROUP = 0x0019
_PRIVATE_ELEMENTS = (0x21, 0x22, 0x23)
_PRIVATE_BLOCKS = range(0x10, 0x100)
_UNPACK, _SEND_ORIGINAL = "unpack it and send the DICOM files in it", "send the DICOM file from which it was made"
_OTHER_FORMATS = {
    b"PK\x03\x04": ("a ZIP archive", _UNPACK),
    b"\x1f\x8b": ("a gzip file", _UNPACK),
    b"7z\xbc\xaf\x27\x1c": ("a 7-Zip archive", _UNPACK),
    b"Rar!": ("a RAR archive", _UNPACK),
    b"%PDF-": ("a PDF document", _SEND_ORIGINAL),
    b"\x89PNG": ("a PNG picture", _SEND_ORIGINAL),
    b"\xff\xd8\xff": ("a JPEG picture", _SEND_ORIGINAL),
}
"""Files that people send in place of DICOM files, by their first bytes: a name, and what to do."""
_OVERLAY_GROUPS, _OVERLAY_BIT_POSITION = range(0x6000, 0x6020, 2), 0x0102
"""OverlayBitPosition (60xx,0102) of the sixteen overlays of PS3.3 C.9.2."""


def _tag(attribute: str | BaseTag) -> BaseTag:
    """Return the tag of a keyword; a tag is returned unchanged."""
    if isinstance(attribute, BaseTag):
        return attribute
    tag = tag_for_keyword(attribute)
    if tag is None:
        raise KeyError(attribute)
    return Tag(tag)


# The service reads only these. Patient data stays in the file; its form is checked for a warning.
_WANTED: list[BaseTag | int] = [
    *(_tag(keyword) for keyword in (*_PLAIN, *_MACROS_OF, *_FRAME_GROUPS, *_PATIENT_AND_STUDY)),
    *(Tag(group, _OVERLAY_BIT_POSITION) for group in _OVERLAY_GROUPS),
    *(Tag(_PRIVATE_GROUP, block) for block in _PRIVATE_BLOCKS),
    *(Tag(_PRIVATE_GROUP, block << 8 | element) for block in _PRIVATE_BLOCKS for element in _PRIVATE_ELEMENTS),
]


@dataclass(frozen=True, slots=True)
class PixelElement:
    """The place of the top-level PixelData value in the file: offset and announced length in bytes; and its VR."""

    offset: int
    length: int
    vr: str = "OW"


class Header:
    """The attributes of one instance that the service reads.

    An Enhanced object keeps some attributes in functional groups. A look-up by keyword takes the first value of these places:
    the data set itself, the group shared by all frames, the first frame's group. An optional attribute with an unreadable
    value counts as absent.
    """

    def __init__(
        self,
        dataset: Dataset,
        transfer_syntax: str,
        pixel_element: PixelElement | None,
        size: int,
        unknown_representation: BaseTag | None = None,
    ) -> None:
        self.transfer_syntax = transfer_syntax
        self.unknown_representation = unknown_representation
        self.pixel_element = pixel_element
        self.file_size = size
        self._dataset = dataset
        shared, self._per_frame = (self._items(dataset, keyword) for keyword in _FRAME_GROUPS)
        self._groups = [*shared[:1], *self._per_frame[:1]]

    def numbers(self, keyword: str) -> tuple[float, ...]:
        """Return all values of a numeric attribute.

        There are none when it is absent, empty, unreadable or not finite.
        """
        for dataset in self._places(keyword):
            if values := self._numbers(dataset, keyword):
                return values
        return ()

    def holds(self, keyword: str) -> bool:
        """Return whether an attribute exists and is not empty, readable or not."""
        return any(self._value(dataset, keyword) not in (None, "", b"") for dataset in self._places(keyword))

    def number(self, keyword: str) -> float | None:
        """Return the first value of a numeric attribute."""
        values = self.numbers(keyword)
        return values[0] if values else None

    def integer(self, keyword: str) -> int | None:
        """Return the first value of an attribute that counts.

        None also when it is not a whole number.
        """
        value = self.number(keyword)
        return int(value) if value is not None and value == int(value) else None

    def texts(self, keyword: str) -> tuple[str, ...]:
        """Return all values of a text or UID attribute, stripped.

        There are none when it is absent or unreadable.
        """
        for dataset in self._places(keyword):
            if values := self._texts(dataset, keyword):
                return values
        return ()

    def text(self, keyword: str) -> str:
        """Return the first value of a text attribute, "" when absent."""
        values = self.texts(keyword)
        return values[0] if values else ""

    def numbers_per_frame(self, keyword: str) -> list[tuple[float, ...]]:
        """Return the values in each frame's own functional groups.

        There are none for objects without such groups.
        """
        return [self._numbers(item, keyword) for item in self._macro_items(keyword)]

    def texts_per_frame(self, keyword: str) -> list[tuple[str, ...]]:
        """Return texts as :meth:`numbers_per_frame` returns numbers."""
        return [self._texts(item, keyword) for item in self._macro_items(keyword)]

    def private_number(self, creator: str, element: int) -> float | None:
        """Return the first value of a private element of group 0019.

        Parameters
        ----------
        creator : str
            Value of the element that reserves the block, PS3.5 section 7.8.1.
        element : int
            Number within the block; the service reads 21, 22 and 23 (hexadecimal) only.
        """
        # By the elements that are there: most files have none of the 240 blocks.
        for tag in sorted(tag for tag in self._dataset.keys() if tag.group == _PRIVATE_GROUP):  # noqa: SIM118
            block = tag.element
            if block in _PRIVATE_BLOCKS and self._texts(self._dataset, tag) == (creator,):
                values = self._numbers(self._dataset, Tag(_PRIVATE_GROUP, block << 8 | element))
                return values[0] if values else None
        return None

    def overlay_bits(self) -> tuple[int, ...]:
        """Return OverlayBitPosition (60xx,0102) of every overlay."""
        found = (self._numbers(self._dataset, Tag(group, _OVERLAY_BIT_POSITION)) for group in _OVERLAY_GROUPS)
        return tuple(int(position) for positions in found for position in positions)

    def code(self, *sequences: str) -> str:
        """Return the value of a code; "" when absent.

        ``sequences`` is the path to its item: code sequences, each in the first item of the one before.
        """
        dataset = self._dataset
        for sequence in sequences:
            dataset = (self._items(dataset, sequence)[:1] or [Dataset()])[0]
        return next(iter(self._texts(dataset, "CodeValue")), "")

    def tags(self, keyword: str) -> tuple[int, ...]:
        """Return the values of an attribute that refers to other attributes (VR AT)."""
        return tuple(int(value) for value in _values(self._value(self._dataset, keyword)) if isinstance(value, int))

    @property
    def names_need_repair(self) -> bool:
        """Whether a result cannot carry the patient and study attributes as they are."""
        part = Dataset()
        for tag in map(_tag, _PATIENT_AND_STUDY):
            if tag in self._dataset:
                part[tag] = self._dataset.get_item(tag)
        return bool(repair(part))

    def _places(self, keyword: str) -> Iterator[Dataset]:
        yield self._dataset
        for macro in _MACROS_OF.get(keyword, ()):
            for group in self._groups:
                yield from self._items(group, macro)[:1]

    def _macro_items(self, keyword: str) -> Iterator[Dataset]:
        for frame in self._per_frame:
            items = itertools.chain.from_iterable(self._items(frame, macro)[:1] for macro in _MACROS_OF[keyword])
            yield next((item for item in items if keyword in item), Dataset())

    def _items(self, dataset: Dataset, keyword: str) -> list[Dataset]:
        tag = _tag(keyword)
        if tag not in dataset:
            return []
        raw = dataset.get_item(tag)
        # pydicom makes an object of about 2 kB for each item, even for an empty one.
        if (
            isinstance(raw, RawDataElement)
            and raw.value is not None
            and raw.value.count(_ITEM_TAG[raw.is_little_endian]) > SEQUENCE_ITEMS
        ):
            raise dicom_problem(
                DicomCode.HEADER_TOO_LARGE, f"{keyword} has too many items; export the run again.", keyword
            )
        items = self._value(dataset, keyword)
        # With another value representation than SQ the value is text or numbers.
        return [item for item in _values(items) if isinstance(item, Dataset)]

    def _numbers(self, dataset: Dataset, attribute: str | BaseTag) -> tuple[float, ...]:
        try:
            values = tuple(float(value) for value in _values(self._value(dataset, attribute)))
        except (TypeError, ValueError):
            return ()
        return values if all(math.isfinite(value) for value in values) else ()

    def _texts(self, dataset: Dataset, attribute: str | BaseTag) -> tuple[str, ...]:
        # A number under the tag of a text or a UID has another representation, and no reader of the text finds it.
        found = _values(self._value(dataset, attribute))
        values = tuple(value.strip(" \0") for value in found if isinstance(value, str))
        return values if any(values) else ()

    @staticmethod
    def _value(dataset: Dataset, attribute: str | BaseTag) -> Any:
        tag = _tag(attribute)
        if tag not in dataset:
            return None
        # The conversion of a damaged value raises nearly anything, from ValueError to struct.error. The value then counts
        # as absent, and the caller reports a value that it needs.
        try:
            return dataset[tag].value
        except Problem:
            raise
        except Exception:
            return None


def _values(value: Any) -> list[Any]:
    if value is None or value == "":
        return []
    if isinstance(value, str | bytes | int | float):
        return [value]
    try:
        return list(value)
    except TypeError:
        return [value]


class _BoundedReader:
    """A file with a limit on reading: its end, and a budget.

    It remembers the problem, because pydicom hides some exceptions.
    """

    def __init__(self, file: BufferedReader) -> None:
        self._file = file
        self._bytes = HEADER_BYTES
        self._reads = HEADER_READS
        self.problem: Problem | None = None

    def read(self, count: int = -1) -> bytes:
        self._bytes -= count
        self._reads -= 1
        if count < 0 or self._bytes < 0 or self._reads < 0:
            self.problem = dicom_problem(
                DicomCode.HEADER_TOO_LARGE,
                "The attributes before the pixel data are too large for an image; export the run without private data.",
            )
            raise self.problem
        value = self._file.read(count)
        # pydicom asks for the 8 bytes of the next element's header to detect the end of the file.
        if len(value) < count and not (count == 8 and not value):
            self.problem = truncation_problem()
            raise self.problem
        return value

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()


def truncation_problem(where: str | None = None) -> Problem:
    """Return the problem of a file that ends too early."""
    return dicom_problem(DicomCode.TRUNCATED, "The file ends before its announced end; send it again.", where)


def read_header(file: BufferedReader) -> Header:
    """Read the attributes of a DICOM file, and the place of its pixel data.

    Parameters
    ----------
    file : binary file
        As :func:`fluoromap_service.dicom.inflation.open_dicom` opens it.

    Raises
    ------
    Problem
        ``not_dicom``, ``no_part10_header``, ``malformed``, ``truncated``, ``header_too_large``.

    References
    ----------
    PS3.10 section 7.1 (file meta information), PS3.5 chapter 7 (data elements).
    """
    return _bounded(file, _parse)


@dataclass(frozen=True, slots=True)
class FileMeta:
    """The file meta information (PS3.10 section 7.1), and the place of the data set after it."""

    transfer_syntax: str
    sop_class_uid: str
    sop_instance_uid: str
    data_set_start: int


def read_file_meta(file: BufferedReader) -> FileMeta:
    """Read the file meta information.

    Raises
    ------
    Problem
        As :func:`read_header`.
    """
    return _bounded(file, lambda reader, size: _file_meta(reader))


def data_set_start(file: BufferedReader) -> tuple[str, int]:
    """Return the transfer syntax, and the place of the data set after the file meta information.

    Raises
    ------
    Problem
        As :func:`read_header`.
    """
    meta = read_file_meta(file)
    return meta.transfer_syntax, meta.data_set_start


def read_attributes(file: BufferedReader) -> tuple[str, Dataset]:
    """Return the transfer syntax, and all attributes before the pixel data.

    The file is then at the element PixelData.

    Raises
    ------
    Problem
        As :func:`read_header`.
    """
    syntax, place = data_set_start(file)
    file.seek(place)
    dataset = read_dataset(
        file,
        syntax == ImplicitVRLittleEndian,
        syntax != ExplicitVRBigEndian,
        stop_when=lambda tag, representation, length: tag == _PIXEL_DATA,
    )
    return syntax, dataset


def read_all_attributes(file: BufferedReader) -> tuple[Dataset, bool]:
    """Read every attribute before the pixel data, as far as possible.

    :func:`read_header` skips what the service does not use, so it accepts a file that is damaged there. This function keeps
    the attributes before such a damage. Values above ``LONGEST_VALUE_BYTES`` are not read.

    Returns
    -------
    tuple of Dataset and bool
        The attributes, and whether these are all.

    Raises
    ------
    Problem
        As :func:`read_header`, for damaged file meta information.
    """
    return _bounded(file, _parse_all)


def _parse_all(reader: _BoundedReader, size: int) -> tuple[Dataset, bool]:
    stream = cast(Any, reader)
    syntax = _file_meta(reader).transfer_syntax
    start = reader.tell()
    implicit, little_endian = syntax == ImplicitVRLittleEndian, syntax != ExplicitVRBigEndian

    def at_pixel_data(tag: BaseTag, vr: str | None, length: int) -> bool:
        return int(tag) == _PIXEL_DATA

    try:
        return (
            read_dataset(stream, implicit, little_endian, stop_when=at_pixel_data, defer_size=LONGEST_VALUE_BYTES),
            True,
        )
    except Exception:
        # The damage may raise anything, also a RecursionError for sequences without end.
        reader.seek(start)
    found: dict[BaseTag, Any] = {}
    elements = data_element_generator(stream, implicit, little_endian, at_pixel_data, defer_size=LONGEST_VALUE_BYTES)
    with suppress(Exception):
        for element in elements:
            found[element.tag] = element
    dataset = Dataset(found)
    charset = dataset.get("SpecificCharacterSet") if _CHARACTER_SET in found else None
    dataset.set_original_encoding(implicit, little_endian, convert_encodings(charset))
    return dataset, False


def _bounded(file: BufferedReader, parse: Callable[[_BoundedReader, int], Result]) -> Result:
    """Call ``parse`` with a bounded reader after the preamble, and the size of the file."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    start = file.read(132)
    if start[128:] != b"DICM":
        raise _no_preamble(start)
    reader = _BoundedReader(file)
    try:
        return parse(reader, size)
    except Problem:
        raise
    except Exception as error:
        if reader.problem is not None:
            raise reader.problem from None
        if reader.tell() >= size:
            raise truncation_problem() from None
        raise dicom_problem(DicomCode.MALFORMED, "The DICOM header is damaged; export the run again.") from error


def _file_meta(reader: _BoundedReader) -> FileMeta:
    stream = cast(Any, reader)
    keywords = ("TransferSyntaxUID", "MediaStorageSOPClassUID", "MediaStorageSOPInstanceUID")
    meta = read_dataset(
        stream, False, True, stop_when=lambda tag, vr, length: tag.group != 2, specific_tags=[*map(_tag, keywords)]
    )
    syntax, sop_class_uid, sop_instance_uid = (str(meta.get(keyword, "")).strip(" \0") for keyword in keywords)
    if not syntax:
        raise dicom_problem(
            DicomCode.MALFORMED,
            "The file meta information has no TransferSyntaxUID; export the run again.",
            "TransferSyntaxUID",
        )
    return FileMeta(syntax, sop_class_uid, sop_instance_uid, reader.tell())


def _parse(reader: _BoundedReader, size: int) -> Header:
    stream = cast(Any, reader)
    meta = _file_meta(reader)
    syntax = meta.transfer_syntax
    if meta.sop_class_uid == MediaStorageDirectoryStorage:
        raise dicom_problem(
            DicomCode.NOT_XA,
            "This is a DICOMDIR, the table of contents of a disc; send the image files that lie beside it.",
            "MediaStorageSOPClassUID",
        )
    found: list[PixelElement] = []
    unknown: list[tuple[BaseTag, str | None]] = []

    def at_pixel_data(tag: BaseTag, vr: str | None, length: int) -> bool:
        if tag == _PIXEL_DATA:
            found.append(PixelElement(reader.tell(), length, vr or "OW"))
            return True
        if vr not in _REPRESENTATIONS and syntax != ImplicitVRLittleEndian:
            unknown.append((tag, vr))
        if length != UNDEFINED_LENGTH and reader.tell() + length > size:
            raise truncation_problem()
        return False

    try:
        dataset = read_dataset(
            stream,
            syntax == ImplicitVRLittleEndian,
            syntax != ExplicitVRBigEndian,
            stop_when=at_pixel_data,
            specific_tags=_WANTED,
        )
    except Exception:
        # The length of such an element is a guess, so that the parser reads on at a wrong place.
        if unknown:
            raise representation_problem(unknown[0][0]) from None
        raise
    # An element without any letters is one of implicit representation, which readers understand.
    named = [tag for tag, vr in unknown if vr is not None]
    return Header(dataset, syntax, found[-1] if found else None, size, named[0] if named else None)


def representation_problem(tag: BaseTag) -> Problem:
    """Return the problem of an element whose value representation (VR) no edition of DICOM has."""
    return dicom_problem(
        DicomCode.MALFORMED,
        f"The element ({tag.group:04X},{tag.element:04X}) has an unknown value representation (VR); "
        "export the run again, without this element.",
        f"({tag.group:04X},{tag.element:04X})",
    )


def _no_preamble(start: bytes) -> Problem:
    # A bare data set begins with an element of group 0002 or 0008, PS3.5 section 7.1.
    if start[:2] in (b"\x02\x00", b"\x08\x00") and len(start) >= 8:
        return dicom_problem(
            DicomCode.NO_PART10_HEADER,
            "This looks like a bare DICOM data set; export it as a DICOM file with preamble and file meta information.",
        )
    if not start:
        return dicom_problem(DicomCode.NOT_DICOM, "The file is empty; send it again.")
    for first_bytes, (kind, advice) in _OTHER_FORMATS.items():
        if start.startswith(first_bytes):
            return dicom_problem(DicomCode.NOT_DICOM, f"This is {kind}, not a DICOM file; {advice}.")
    return dicom_problem(DicomCode.NOT_DICOM, "This is not a DICOM file; send DICOM files only.")
