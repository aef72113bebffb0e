"""DICOM headers as devices and other programs write them against the standard, drawn at random.

Each kind stands for files that other programs accepted and then stumbled over: character sets, missing type 2 attributes, numbers
that are none, partial dates, delimiters without a sequence, offset tables, unknown value representations.
"""

from __future__ import annotations

import io
import random
import struct
from collections.abc import Callable

import pydicom
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate, generate_frames
from pydicom.uid import generate_uid

Element = tuple[int, str, bytes]
"""Tag, value representation and value of an element that replaces the one in the file."""
Change = Callable[[random.Random, Dataset], list[Element]]
"""Changes a data set, and returns the elements that no writer would make."""
CHARACTER_SETS = (
    "\\ISO 2022 IR 87", "", "ISO_IR 6", "ISO IR 192", "ISO_IR 192", "ISO_IR 100", "ISO 2022 IR 149", "\\ISO 2022 IR 149", "GB18030",
    "ISO_IR 13", "ISO 2022 IR 6\\ISO 2022 IR 87", "LATIN1", "utf-8", "ISO_IR 999",
)  # fmt: skip
NAMES = (
    b"Yamada^Tarou=\x1b$B;3ED\x1b(B^\x1b$BB@O:\x1b(B", b"M\xc3\x9cLLER^JOHN", b"M\xdcLLER",
    b"Hong^Gildong=\x1b$)C\xfb\xf3^\x1b$)C\xd1\xce",
    b"DOE^JOHN^^", b"^^^^", b"=====", b"A\\B", b"\xff\xfe\xfd", b"X" * 200, b"",
)  # fmt: skip
KEPT = ("SOPInstanceUID", "SOPClassUID")
"""Without these a file is no run, and the service refuses it at the door."""
TYPE_2 = (
    "PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "StudyID", "AccessionNumber",
    "ReferringPhysicianName", "SeriesNumber", "Laterality", "InstanceNumber",
)  # fmt: skip
ODD_TEXTS = {
    "DA": (b"2024", b"202401", b"2024.01.05", b"20241301", b"00000000", b"20240105-20240106", b"5.1.2024", b"        "),
    "TM": (b"10", b"1011", b"10:11:12", b"101112.1234567", b"246060", b"10:11", b"101112.", b"-"),
    "DT": (
        b"2024",
        b"20240105",
        b"2024010510",
        b"20240105101112.5+0100",
        b"20240105101112&ZZXX",
        b"2024-01-05T10:11:12",
    ),
    "DS": (b"NaN", b"nan", b"inf", b"-INF", b"1,5", b"1e400", b"0x10", b"1.5\\NaN", b"1.23456789012345678", b" "),
    "IS": (b"1.0", b"2147483648", b"-", b"1e3", b"NaN", b"0x1F", b" "),
    "CS": (b"?", b"male", b"M\\F", b"\x00", b"A" * 40, b"m"),
    "UI": (b"1.2.", b"1..2", b"01.02", b"x", b"1." * 60, b"1.2.3\x00\x00"),
}
"""Values of a text representation that the standard does not allow, or whose precision is partial."""


def odd_header(chance: random.Random, content: bytes) -> bytes:
    """Return a new object with one to three oddities in its header."""
    dataset = pydicom.dcmread(io.BytesIO(content))
    dataset.SOPInstanceUID = dataset.file_meta.MediaStorageSOPInstanceUID = generate_uid(
        entropy_srcs=[str(chance.random())]
    )
    changes = chance.choices(CHANGES, k=chance.choice((1, 1, 2, 3)))
    elements = [element for change in changes for element in change(chance, dataset)]
    strays = [_stray_bytes(chance) for _ in range(chance.choice((0, 0, 1, 2)))]
    stream = io.BytesIO()
    pydicom.dcmwrite(stream, dataset, enforce_file_format=True)
    written = stream.getvalue()
    for element in elements:
        written = _with_element(written, element)
    return _inserted(written, b"".join(strays), _STUDY_DATE)


def _character_set(chance: random.Random, dataset: Dataset) -> list[Element]:
    return [(0x00080005, "CS", chance.choice(CHARACTER_SETS).encode()), (0x00100010, "PN", chance.choice(NAMES))]


def _without_type_2(chance: random.Random, dataset: Dataset) -> list[Element]:
    for keyword in chance.sample(TYPE_2, chance.randrange(1, 5)):
        if keyword in dataset:
            delattr(dataset, keyword)
    return []


def _odd_text(chance: random.Random, dataset: Dataset) -> list[Element]:
    present = [each for each in dataset if each.VR in ODD_TEXTS and each.keyword not in KEPT]
    element = chance.choice(present)
    return [(int(element.tag), element.VR, chance.choice(ODD_TEXTS[element.VR]))]


def _odd_number(chance: random.Random, dataset: Dataset) -> list[Element]:
    value = chance.choice((float("nan"), float("inf"), float("-inf"), -0.0, 1e308))
    tag, representation, form = chance.choice((
        (0x00189328, "FD", "<d"), (0x00181622, "FL", "<f"), (0x00189073, "FD", "<d"), (0x00280120, "FD", "<d"),
        (0x00189322, "FD", "<dd"),
    ))  # fmt: skip
    packed = struct.pack("<f", float(value) if abs(value) < 1e38 or value != value else float("inf"))
    return [(tag, representation, packed if form == "<f" else struct.pack("<d", value) * (len(form) - 1))]


def _offset_table(chance: random.Random, dataset: Dataset) -> list[Element]:
    if dataset.file_meta.TransferSyntaxUID.is_encapsulated:
        frames = list(generate_frames(dataset.PixelData, number_of_frames=int(dataset.get("NumberOfFrames", 1))))
        pixels = bytearray(encapsulate([frame.ljust(2, b"\x00") for frame in frames], has_bot=True))
        entries = struct.unpack_from("<I", pixels, 4)[0] // 4
        for entry in range(entries):
            if chance.random() < 0.5:
                struct.pack_into("<I", pixels, 8 + 4 * entry, chance.choice((0, 1, 0xFFFFFFFF, 10**6)))
        dataset.PixelData = bytes(pixels)
        dataset["PixelData"].VR = "OB"
        dataset["PixelData"].is_undefined_length = True
    return []


def _overlay(chance: random.Random, dataset: Dataset) -> list[Element]:
    values = ((0x60000010, (0, 1, 65535)), (0x60000100, (1, 12, 16, 0)), (0x60000102, (0, 12, 15, 99)))
    return [(tag, "US", struct.pack("<H", chance.choice(choices))) for tag, choices in values]


def _private(chance: random.Random, dataset: Dataset) -> list[Element]:
    content = chance.randbytes(chance.choice((0, 2, 64)))
    return [
        (0x00090010, "LO", chance.choice((b"ODD DEVICE", b"", b"\xff\xff", b"A\\B"))),
        (0x00091001, chance.choice(("UN", "OB", "LT", "DS")), content),
    ]


CHANGES: tuple[Change, ...] = (
    _character_set, _character_set, _without_type_2, _odd_text, _odd_text, _odd_number, _offset_table, _overlay, _private,
)  # fmt: skip


def _stray_bytes(chance: random.Random) -> bytes:
    """Return an element that no writer would make, in explicit little endian."""
    return chance.choice((
        bytes.fromhex("feffdde000000000"),  # the end of a sequence that never began
        bytes.fromhex("feff0de000000000"),  # the end of an item that never began
        bytes.fromhex("feff00e000000000"),  # an item outside a sequence
        bytes.fromhex("08001511") + b"SQ\x00\x00" + struct.pack("<I", 0) + bytes.fromhex("feff00e000000000"),
        bytes.fromhex("08001511") + b"SQ\x00\x00" + struct.pack("<I", 0xFFFFFFFF) + bytes.fromhex("feffdde000000000"),
        bytes.fromhex("08001610") + b"ZZ" + struct.pack("<H", 4) + b"abcd",  # an unknown value representation
        bytes.fromhex("08001610") + b"UN\x00\x00" + struct.pack("<I", 4) + b"abcd",
        bytes.fromhex("08001610") + b"OV\x00\x00" + struct.pack("<I", 8) + b"abcdefgh",
        bytes.fromhex("08001610") + b"  " + struct.pack("<H", 2) + b"ab",
    ))  # fmt: skip


_STUDY_DATE = bytes.fromhex("08002000") + b"DA"
_PIXELS = bytes.fromhex("e07f1000") + b"O"
_LONG = ("OB", "UN")
"""Of the representations above those with a length of four bytes (PS3.5 section 7.1.2)."""


def _with_element(content: bytes, element: Element) -> bytes:
    """Replace an element of the top level, or insert it before a later one."""
    tag, representation, value = element
    start = struct.pack("<HH", tag >> 16, tag & 0xFFFF)
    value += (b"\x00" if representation in ("OB", "UN", "UI") else b" ") * (len(value) % 2)
    length = b"\x00\x00" + struct.pack("<I", len(value)) if representation in _LONG else struct.pack("<H", len(value))
    written = start + representation.encode() + length + value
    place = content.find(start + representation.encode())
    if place < 0:
        return _inserted(content, written, _STUDY_DATE if tag < 0x00080020 else _PIXELS)
    end = place + 8 + int.from_bytes(content[place + 6 : place + 8], "little")
    return content[:place] + written + content[end:]


def _inserted(content: bytes, more: bytes, before: bytes) -> bytes:
    place = content.find(before)
    return content if place < 0 else content[:place] + more + content[place:]
