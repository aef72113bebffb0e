"""The de-identification of a data set."""

from __future__ import annotations

import re

from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset
from pydicom.multival import MultiValue
from pydicom.tag import BaseTag, Tag

from fluoromap_service.dicom.deidentification.profile import Action, action_for
from fluoromap_service.dicom.deidentification.pseudonyms import DUMMY_DATE, Dates, Pseudonyms
from fluoromap_service.dicom.facts import is_uid

METHOD = "PS3.15 Basic Profile; pixels not examined, burned-in text stays"
_REGISTERED = "1.2.840.10008."
"""UIDs of the standard itself: SOP classes, transfer syntaxes."""
_NUMBERS = frozenset({"DS", "IS"})
_TIMES = frozenset({"DA", "DT", "TM"})
_TEXTS = frozenset({"LT", "ST", "UT", "UC", "UR"})
_PATIENT_GROUP = 0x0010
_DUMMIES = {"DA": DUMMY_DATE, "DT": f"{DUMMY_DATE}000000", "TM": "000000", "DS": "0", "IS": "0", "AS": "000Y"}
_CODES = {
    Dates.REMOVE: (),
    Dates.SHIFT: (("113107", "Retain Longitudinal Temporal Information Modified Dates Option"),),
    Dates.KEEP: (("113106", "Retain Longitudinal Temporal Information Full Dates Option"),),
}
_LONGITUDINAL = {Dates.REMOVE: "REMOVED", Dates.SHIFT: "MODIFIED", Dates.KEEP: "UNMODIFIED"}

# GE states the table's position in private elements only. They hold numbers alone.
_SAFE_CREATOR = "DLX_SERIE_01"
_SAFE_GROUP = 0x0019
_SAFE_ELEMENTS = frozenset({0x21, 0x22, 0x23})


def deidentify(dataset: Dataset, pseudonyms: Pseudonyms) -> dict[str, str]:
    """Remove the identity of the patient from a data set without pixels, in place.

    The attributes of PS3.15 table E.1-1 are treated as it says. Beyond it, long texts, persons' names, dates, unknown
    attributes and private attributes are removed; of the private ones only GE's table position stays, which is numbers.

    Returns
    -------
    dict of str
        The new UIDs by the original ones.
    """
    uids: dict[str, str] = {}
    _clean(dataset, pseudonyms, uids)
    # The caret marks a family name, without which readers warn (PS3.5 section 6.2.1).
    dataset.PatientName, dataset.PatientID = f"{pseudonyms.name}^", pseudonyms.name
    dataset.PatientIdentityRemoved = "YES"
    dataset.DeidentificationMethod = METHOD
    dataset.DeidentificationMethodCodeSequence = [_code("113100", "Basic Application Confidentiality Profile")]
    dataset.DeidentificationMethodCodeSequence += [_code(*code) for code in _CODES[pseudonyms.dates]]
    if any(element.tag.is_private for element in dataset):
        dataset.DeidentificationMethodCodeSequence.append(_code("113111", "Retain Safe Private Option"))
    dataset.LongitudinalTemporalInformationModified = _LONGITUDINAL[pseudonyms.dates]
    return uids


def _code(value: str, meaning: str) -> Dataset:
    item = Dataset()
    item.CodeValue, item.CodingSchemeDesignator, item.CodeMeaning = value, "DCM", meaning
    return item


def _clean(dataset: Dataset, pseudonyms: Pseudonyms, uids: dict[str, str]) -> None:
    safe = _safe_private(dataset)
    for tag in list(dataset.keys()):
        if tag in safe:
            continue
        if tag.is_private:
            del dataset[tag]
            continue
        try:
            element = dataset[tag]
        except Exception:
            # The conversion of a damaged value raises nearly anything; nobody knows what such a value names.
            del dataset[tag]
            continue
        if element.VR in _NUMBERS and not all(_is_number(value) for value in _values(element)):
            # Only a damaged or misused attribute has another text.
            del dataset[tag]
            continue
        action = _action(element, pseudonyms.dates)
        if element.VR == "SQ" and action in (None, Action.CLEAN_INSIDE):
            for item in element.value:
                _clean(item, pseudonyms, uids)
        elif action is None and element.VR in _TIMES:
            _move(element, pseudonyms)
        elif action is Action.REMOVE:
            del dataset[tag]
        elif action in (Action.EMPTY, Action.CLEAN_INSIDE):
            element.value = [] if element.VR == "SQ" else None
        elif action is Action.DUMMY:
            _set_dummy(element)
        elif action is Action.NEW_UID:
            _replace_uids(element, pseudonyms, uids)


def _action(element: DataElement, dates: Dates) -> Action | None:
    """Return the action for an attribute; None leaves it, or moves a date."""
    action = action_for(element.tag)
    if element.VR in _TIMES and element.tag.group != _PATIENT_GROUP and dates is not Dates.REMOVE:
        return None
    if action is not None:
        return action
    if element.VR == "UI":
        return Action.NEW_UID
    if element.VR == "PN":
        return Action.EMPTY
    if element.VR in _TIMES or element.VR in _TEXTS or element.VR == "UN":
        return Action.REMOVE
    return None


def _move(element: DataElement, pseudonyms: Pseudonyms) -> None:
    if not element.value:
        return
    move = _checked_time if element.VR == "TM" else pseudonyms.moved
    values = [move(str(value)) for value in _values(element)]
    element.value = values if len(values) > 1 else values[0]


def _checked_time(text: str) -> str:
    """Return a time of day; empty for another text."""
    return text if re.fullmatch(r"[0-9:. -]*", text) else ""


def _set_dummy(element: DataElement) -> None:
    if element.VR == "SQ":
        element.value = []
    elif element.VR in ("OB", "OW", "OF", "OD", "OL", "OV", "US", "SS", "UL", "SL", "FL", "FD", "AT", "UV", "SV"):
        element.value = None
    else:
        element.value = _DUMMIES.get(element.VR, "REMOVED")


def _replace_uids(element: DataElement, pseudonyms: Pseudonyms, uids: dict[str, str]) -> None:
    values = [str(value) for value in _values(element) if value]
    new = [value if value.startswith(_REGISTERED) and is_uid(value) else pseudonyms.uid(value) for value in values]
    uids.update({old: made for old, made in zip(values, new, strict=True) if old != made})
    element.value = new if len(new) > 1 else "".join(new)


def _values(element: DataElement) -> list[object]:
    return list(element.value) if isinstance(element.value, MultiValue) else [element.value]


def _safe_private(dataset: Dataset) -> set[BaseTag]:
    """Return the tags of GE's table position and of its block's creator (PS3.5 section 7.8.1)."""
    try:
        block = dataset.private_block(_SAFE_GROUP, _SAFE_CREATOR)
    except KeyError:
        return set()
    tags = {block.get_tag(number) for number in _SAFE_ELEMENTS if number in block}
    numbers = {tag for tag in tags if _is_number(dataset[tag].value)}
    return {*numbers, Tag(_SAFE_GROUP, block.block_start >> 8)} if numbers else set()


def _is_number(value: object) -> bool:
    """Return whether a value is a number, or empty."""
    text = value.decode("latin-1") if isinstance(value, bytes) else str("" if value is None else value)
    return re.fullmatch(r"[0-9eE+. -]*", text) is not None
