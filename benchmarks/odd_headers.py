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
from pydicom.dataelem import RawDataElement
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate, generate_frames
from pydicom.tag import Tag
from pydicom.uid import generate_uid

Change = Callable[[random.Random, Dataset], None]
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
    """Return a run with one to three oddities in its header, as a new object of its study."""
    dataset = pydicom.dcmread(io.BytesIO(content))
    dataset.SOPInstanceUID = dataset.file_meta.MediaStorageSOPInstanceUID = generate_uid(
        entropy_srcs=[str(chance.random())]
    )
    patches: list[bytes] = []
    for change in chance.choices(CHANGES, k=chance.choice((1, 1, 2, 3))):
        change(chance, dataset)
    for _ in range(chance.choice((0, 0, 1, 2))):
        patches.append(_raw_element(chance))
    stream = io.BytesIO()
    pydicom.dcmwrite(stream, dataset, enforce_file_format=True)
    return _with_elements(stream.getvalue(), patches)


def _character_set(chance: random.Random, dataset: Dataset) -> None:
    _raw(dataset, 0x00080005, "CS", chance.choice(CHARACTER_SETS).encode())
    _raw(dataset, 0x00100010, "PN", chance.choice(NAMES))


def _without_type_2(chance: random.Random, dataset: Dataset) -> None:
    for keyword in chance.sample(TYPE_2, chance.randrange(1, 5)):
        if keyword in dataset:
            delattr(dataset, keyword)


def _odd_text(chance: random.Random, dataset: Dataset) -> None:
    present = [each for each in dataset if each.VR in ODD_TEXTS and each.keyword not in KEPT]
    if present:
        element = chance.choice(present)
        _raw(dataset, element.tag, element.VR, chance.choice(ODD_TEXTS[element.VR]))


def _odd_number(chance: random.Random, dataset: Dataset) -> None:
    value = chance.choice((float("nan"), float("inf"), float("-inf"), -0.0, 1e308))
    tag, representation, form = chance.choice((
        (0x00189328, "FD", "<d"), (0x00181622, "FL", "<f"), (0x00189073, "FD", "<d"), (0x00280120, "FD", "<d"),
        (0x00189322, "FD", "<dd"),
    ))  # fmt: skip
    packed = struct.pack("<f", float(value) if abs(value) < 1e38 or value != value else float("inf"))
    _raw(dataset, tag, representation, packed if form == "<f" else struct.pack("<d", value) * (len(form) - 1))


def _offset_table(chance: random.Random, dataset: Dataset) -> None:
    if dataset.file_meta.TransferSyntaxUID.is_encapsulated:
        frames = list(generate_frames(dataset.PixelData, number_of_frames=int(dataset.get("NumberOfFrames", 1))))
        pixels = bytearray(encapsulate(frames, has_bot=True))
        entries = struct.unpack_from("<I", pixels, 4)[0] // 4
        for entry in range(entries):
            if chance.random() < 0.5:
                struct.pack_into("<I", pixels, 8 + 4 * entry, chance.choice((0, 1, 0xFFFFFFFF, 10**6)))
        dataset.PixelData = bytes(pixels)
        dataset["PixelData"].VR = "OB"
        dataset["PixelData"].is_undefined_length = True


def _overlay(chance: random.Random, dataset: Dataset) -> None:
    _raw(dataset, 0x60000010, "US", struct.pack("<H", chance.choice((0, 1, 65535))))
    _raw(dataset, 0x60000100, "US", struct.pack("<H", chance.choice((1, 12, 16, 0))))
    _raw(dataset, 0x60000102, "US", struct.pack("<H", chance.choice((0, 12, 15, 99))))


def _private(chance: random.Random, dataset: Dataset) -> None:
    _raw(dataset, 0x00090010, "LO", chance.choice((b"ODD DEVICE", b"", b"\xff\xff", b"A\\B")))
    _raw(dataset, 0x00091001, chance.choice(("UN", "OB", "LT", "DS")), chance.randbytes(chance.choice((0, 2, 64))))


CHANGES: tuple[Change, ...] = (
    _character_set, _character_set, _without_type_2, _odd_text, _odd_text, _odd_number, _offset_table, _overlay, _private,
)  # fmt: skip


def _raw(dataset: Dataset, tag: int, representation: str, value: bytes) -> None:
    """Set an element to bytes that nobody has checked."""
    padded = (
        value + b" " * (len(value) % 2)
        if representation not in ("OB", "UN", "UI")
        else value + b"\x00" * (len(value) % 2)
    )
    little, implicit = True, dataset.original_encoding[0] or False
    dataset._dict[Tag(tag)] = RawDataElement(Tag(tag), representation, len(padded), padded, 0, implicit, little)


def _raw_element(chance: random.Random) -> bytes:
    """Return the bytes of an element that no writer would make, in explicit little endian."""
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


def _with_elements(content: bytes, elements: list[bytes]) -> bytes:
    """Insert elements before the study's date, between two others of the same group."""
    place = content.find(_STUDY_DATE)
    return content if place < 0 else content[:place] + b"".join(elements) + content[place:]
