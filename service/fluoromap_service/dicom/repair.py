"""Repair of header values that strict readers refuse.

The door accepts what scanners really write. Everything that leaves with a part of such a header takes it from here, so that
every reader accepts it: the results, and the de-identified copies of the runs.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable

from pydicom import config
from pydicom.datadict import dictionary_has_tag, dictionary_VM, dictionary_VR, keyword_for_tag
from pydicom.dataelem import DataElement, RawDataElement
from pydicom.dataset import Dataset
from pydicom.multival import MultiValue
from pydicom.tag import BaseTag, Tag
from pydicom.valuerep import CUSTOMIZABLE_CHARSET_VR, MAX_VALUE_LEN, format_number_as_ds, validate_value

from fluoromap_service.dicom.character_sets import UTF_8, CharacterSets
from fluoromap_service.dicom.date_times import date_text, date_time_text, time_text

PATIENT_AND_STUDY = (
    "PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyInstanceUID", "StudyDate", "StudyTime",
    "AccessionNumber", "ReferringPhysicianName", "StudyID",
)  # fmt: skip
"""The attributes by which an archive files a result with its patient and study, all of type 1 or 2 (PS3.3 C.7.1.1, C.7.2.1)."""

_CHARACTER_SET = Tag("SpecificCharacterSet")
_FIRST_GROUP = 0x0008
"""Elements of lower groups belong to messages and to the file meta information (PS3.5 section 7.1)."""
_DELIMITERS = 0xFFFE
_TEXTUAL = frozenset({
    "AE", "AS", "CS", "DA", "DS", "DT", "IS", "LO", "LT", "PN", "SH", "ST", "TM", "UC", "UI", "UR", "UT",
})  # fmt: skip
_PROSE = frozenset({"LT", "ST", "UT"})
"""One value each, which may have backslashes, tabs and line ends (PS3.5 section 6.2)."""
_PADDING = " \0\t\n\f\r"
"""Characters at the ends of a value that mean nothing."""
_NAME_COMPONENTS, _NAME_GROUPS, _NAME_LENGTH = 5, 3, 64
_CHOICES = {
    Tag("PatientSex"): {"M": "M", "F": "F", "O": "O", "MALE": "M", "FEMALE": "F", "OTHER": "O"},
    Tag("PatientIdentityRemoved"): {"YES": "YES", "NO": "NO"},
}
"""Attributes of a patient with few allowed values (PS3.3 C.7.1.1), by what systems write for each."""


def repair(dataset: Dataset) -> frozenset[str]:
    """Repair all values of a data set in place.

    Its texts are in Unicode afterwards. A value whose meaning is certain gets the form of PS3.5 table 6.2-1. A name or a long
    text is cut at its length. Another wrong value becomes empty. A UID never changes, because it must match that of other
    objects. An attribute that cannot be read is removed.

    Returns
    -------
    frozenset of str
        Keywords of the top-level attributes whose values changed; an attribute without keyword has its tag.
    """
    changed = _repair(dataset, CharacterSets())
    dataset.SpecificCharacterSet = UTF_8
    return changed


def _repair(dataset: Dataset, inherited: CharacterSets) -> frozenset[str]:
    """Repair the values of a data set or of an item, and remove SpecificCharacterSet."""
    changed, sets = set(), inherited
    if _CHARACTER_SET in dataset:
        sets = CharacterSets.declared(_written(dataset.get_item(_CHARACTER_SET)))
        del dataset[_CHARACTER_SET]
        if not sets.defined:
            changed.add(_CHARACTER_SET)
    for tag in list(dataset.keys()):
        if tag.group < _FIRST_GROUP or tag.group == _DELIMITERS:
            del dataset[tag]
        elif not _repair_element(dataset, tag, sets):
            changed.add(tag)
    return frozenset(keyword_for_tag(tag) or str(tag) for tag in changed)


def _repair_element(dataset: Dataset, tag: BaseTag, sets: CharacterSets) -> bool:
    """Repair one attribute; return whether its value is the same."""
    element = dataset.get_item(tag)
    known = dictionary_VR(tag) if dictionary_has_tag(tag) else None
    representation = _representation(known, element)
    if representation in _TEXTUAL:
        if "SQ" in (known, element.VR):
            del dataset[tag]
            return False
        text, certain = _text(element, representation, sets)
        values = [text] if representation in _PROSE else text.split("\\")
        repaired = _values(tag, representation, values)
        dataset[tag] = DataElement(tag, representation, repaired[0] if len(repaired) == 1 else repaired)
        return certain and repaired == [value.strip(_PADDING) for value in values]
    try:
        is_sequence = dataset[tag].VR == "SQ"
        if known is not None and is_sequence is not (known == "SQ"):
            del dataset[tag]
            return False
        items = dataset[tag].value if is_sequence else ()
        return not frozenset().union(*(_repair(item, sets) for item in items))
    except Exception:
        # The conversion of a damaged value raises nearly anything.
        del dataset[tag]
        return False


def _representation(known: str | None, element: DataElement | RawDataElement) -> str:
    """Return the dictionary's representation of a text, else the element's own."""
    return known if known in _TEXTUAL else str(element.VR or "UN")


def _text(element: DataElement | RawDataElement, representation: str, sets: CharacterSets) -> tuple[str, bool]:
    """Return the whole text of an element, and whether its character sets explain it."""
    if isinstance(element, RawDataElement) and representation in CUSTOMIZABLE_CHARSET_VR:
        return sets.text(element.value or b"")
    return _written(element), True


def _written(element: DataElement | RawDataElement) -> str:
    """Return the text of an element that no character set changes."""
    value = element.value
    if isinstance(value, bytes):
        return value.decode("latin_1")
    values = value if isinstance(value, MultiValue | list | tuple) else [value]
    return "\\".join("" if each is None else str(each) for each in values)


def _values(tag: BaseTag, representation: str, values: list[str]) -> list[str]:
    """Return the repaired values; one where the standard allows one (PS3.6)."""
    values = [value.strip(_PADDING) for value in values]
    if len(values) > 1 and dictionary_has_tag(tag) and dictionary_VM(tag) == "1":
        # The door reads the first of several UIDs. Of other values nobody knows which one counts.
        values = {"UI": values[:1], "PN": [" ".join(values)]}.get(representation, [""])
    if tag in _CHOICES:
        return [_CHOICES[tag].get(value.upper(), "") for value in values]
    return [_repaired(representation, value) for value in values]


def _repaired(representation: str, text: str) -> str:
    """Return a value in the form of its representation.

    It is empty where the meaning is uncertain.
    """
    if representation == "UI":
        return text
    if representation in _FORMS:
        text = _FORMS[representation](text)
    elif representation in _PROSE:
        text = _printable(text, "\t\n\f\r")[: MAX_VALUE_LEN.get(representation)].rstrip()
    try:
        validate_value(representation, text, config.RAISE)
    except ValueError:
        return ""
    return text if representation in _PROSE or _printable(text) == text else ""


def _printable(text: str, kept: str = "") -> str:
    """Return a text without control characters, but for those ``kept``."""
    return "".join(each for each in text if each in kept or unicodedata.category(each) != "Cc")


def _name(text: str) -> str:
    """Return a person's name of at most three groups of five components (PS3.5 section 6.2.1)."""
    groups = _printable(text).split("=")[:_NAME_GROUPS]
    return "=".join(_name_group(group) for group in groups)


def _name_group(text: str) -> str:
    *first, last = text.split("^", _NAME_COMPONENTS - 1)
    return "^".join([*first, last.rstrip("^").replace("^", " ")])[:_NAME_LENGTH].strip()


def _age(text: str) -> str:
    match = re.fullmatch(r"(\d{1,3})([DWMY])", text.upper())
    return f"{int(match[1]):03}{match[2]}" if match else ""


def _integer(text: str) -> str:
    text = re.sub(r"\.0*$", "", text)
    return text if re.fullmatch(r"[+-]?\d{1,10}", text) and -(2**31) <= int(text) < 2**31 else ""


def _decimal(text: str) -> str:
    try:
        number = float(text)
    except ValueError:
        return ""
    if len(text) <= MAX_VALUE_LEN["DS"] or not math.isfinite(number):
        return text
    return format_number_as_ds(number)


_FORMS: dict[str, Callable[[str], str]] = {
    "AS": _age, "CS": str.upper, "DA": date_text, "DS": _decimal, "DT": date_time_text, "IS": _integer, "PN": _name,
    "TM": time_text,
}  # fmt: skip
