"""QIDO-RS: searches for stored studies, series and instances (PS3.18 section 10.6)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from fastapi import Request, Response
from fastapi.responses import JSONResponse
from pydicom.datadict import dictionary_VR, tag_for_keyword

from fluoromap_service.api.dicomweb.addresses import instance_url, series_url, study_url
from fluoromap_service.api.dicomweb.store import DICOM_JSON
from fluoromap_service.api.dicomweb.stored import StoredInstance, instances_of
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.problem import Problem

router = new_router("/dicom-web", include_in_schema=False)

DEFAULT_LIMIT, MOST_RESULTS = 100, 500
STUDY_KEYWORDS = (
    "StudyDate", "StudyTime", "AccessionNumber", "ReferringPhysicianName", "PatientName", "PatientID", "PatientBirthDate",
    "PatientSex", "StudyInstanceUID", "StudyID", "StudyDescription",
)  # fmt: skip
"""Attributes of a study in the answers, beside ModalitiesInStudy and the counts (table 10.6.3-3)."""
SERIES_KEYWORDS = ("Modality", "SeriesDescription", "SeriesInstanceUID", "SeriesNumber")
"""Attributes of a series in the answers, beside the count (table 10.6.3-4)."""
INSTANCE_KEYWORDS = (
    "SOPClassUID", "SOPInstanceUID", "InstanceNumber", "Rows", "Columns", "BitsAllocated", "NumberOfFrames",
)  # fmt: skip
"""Attributes of an instance in the answers (table 10.6.3-5)."""

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Search:
    """A search: the attributes to match, the further attributes to return, and the page."""

    matches: dict[str, str]
    include: tuple[str, ...]
    include_all: bool
    limit: int
    offset: int


@router.get("/studies")
def search_studies(request: Request, caller: Reader) -> Response:
    """Search for studies."""
    search = _search(request)
    stored = instances_of()
    wholes = _grouped(stored, "study_uid")
    results = []
    for study_uid, members in _grouped(_matching(stored, search), "study_uid").items():
        whole = wholes[study_uid]
        result = _chosen(members[0].header, STUDY_KEYWORDS, search)
        result |= {
            "00080056": {"vr": "CS", "Value": ["ONLINE"]},
            "00080061": {"vr": "CS", "Value": sorted({_text(each.header, _tag("Modality")) for each in whole})},
            "00081190": {"vr": "UR", "Value": [study_url(str(request.base_url), study_uid)]},
            "00201206": {"vr": "IS", "Value": [len({each.series_uid for each in whole})]},
            "00201208": {"vr": "IS", "Value": [len(whole)]},
        }
        results.append(result)
    return _page(results, search)


@router.get("/series")
def search_all_series(request: Request, caller: Reader) -> Response:
    """Search for series of all studies."""
    return _series(request, instances_of(), (*STUDY_KEYWORDS, *SERIES_KEYWORDS))


@router.get("/studies/{study_uid}/series")
def search_series(study_uid: str, request: Request, caller: Reader) -> Response:
    """Search for series of one study."""
    return _series(request, instances_of(study_uid), ("StudyInstanceUID", *SERIES_KEYWORDS))


def _series(request: Request, stored: list[StoredInstance], keywords: tuple[str, ...]) -> Response:
    search = _search(request)
    wholes = _grouped(stored, "series_uid")
    results = []
    for series_uid, members in _grouped(_matching(stored, search), "series_uid").items():
        url = series_url(str(request.base_url), members[0].study_uid, series_uid)
        result = _chosen(members[0].header, keywords, search)
        result |= {
            "00081190": {"vr": "UR", "Value": [url]},
            "00201209": {"vr": "IS", "Value": [len(wholes[series_uid])]},
        }
        results.append(result)
    return _page(results, search)


@router.get("/instances")
def search_all_instances(request: Request, caller: Reader) -> Response:
    """Search for instances of all studies."""
    return _instances(request, instances_of(), (*STUDY_KEYWORDS, *SERIES_KEYWORDS, *INSTANCE_KEYWORDS))


@router.get("/studies/{study_uid}/instances")
def search_instances_of_study(study_uid: str, request: Request, caller: Reader) -> Response:
    """Search for instances of one study."""
    keywords = ("StudyInstanceUID", *SERIES_KEYWORDS, *INSTANCE_KEYWORDS)
    return _instances(request, instances_of(study_uid), keywords)


@router.get("/studies/{study_uid}/series/{series_uid}/instances")
def search_instances(study_uid: str, series_uid: str, request: Request, caller: Reader) -> Response:
    """Search for instances of one series."""
    keywords = ("StudyInstanceUID", "SeriesInstanceUID", *INSTANCE_KEYWORDS)
    return _instances(request, instances_of(study_uid, series_uid), keywords)


def _instances(request: Request, stored: list[StoredInstance], keywords: tuple[str, ...]) -> Response:
    search = _search(request)
    results = []
    for each in _matching(stored, search):
        result = _chosen(each.header, keywords, search)
        url = instance_url(str(request.base_url), each.study_uid, each.series_uid, each.uid)
        result["00081190"] = {"vr": "UR", "Value": [url]}
        result["00080056"] = {"vr": "CS", "Value": ["ONLINE"]}
        results.append(result)
    return _page(results, search)


def _search(request: Request) -> _Search:
    """Read the parameters of a search.

    Raises
    ------
    Problem
        422 ``unknown_parameter`` for a name that is no DICOM attribute; 422 ``invalid`` for a wrong number.
    """
    matches: dict[str, str] = {}
    include: list[str] = []
    numbers = {"limit": DEFAULT_LIMIT, "offset": 0}
    unknown = []
    for name, value in request.query_params.multi_items():
        if name in numbers:
            if not re.fullmatch(r"[0-9]{1,9}", value):
                raise Problem(422, "invalid", f"{name} is not a number; send 0 or more.", [(f"query.{name}", "wrong")])
            numbers[name] = int(value)
        elif name == "includefield":
            include += value.split(",")
        elif name == "fuzzymatching":
            pass  # Optional in PS3.18; names match without regard to case, and by wildcards.
        elif (tag := _tag(name)) is not None:
            matches[tag] = value
        else:
            unknown.append(name)
    tags = {field: _tag(field) for field in include if field != "all"}
    unknown += [field for field, tag in tags.items() if tag is None]
    if unknown:
        detail = "The address has unknown query parameters; use keywords or tags of DICOM attributes."
        raise Problem(422, "unknown_parameter", detail, [(f"query.{name}", "unknown") for name in unknown])
    return _Search(
        matches,
        tuple(tag for tag in tags.values() if tag is not None),
        "all" in include,
        min(numbers["limit"], MOST_RESULTS),
        numbers["offset"],
    )


def _tag(name: str) -> str | None:
    """Return an attribute's tag as eight hexadecimal digits; None for another name."""
    if re.fullmatch(r"[0-9A-Fa-f]{8}", name):
        return name.upper()
    number = tag_for_keyword(name)
    return None if number is None else f"{number:08X}"


def _matching(stored: Iterable[StoredInstance], search: _Search) -> Iterator[StoredInstance]:
    return (each for each in stored if all(_matches(each.header, tag, text) for tag, text in search.matches.items()))


def _matches(header: Json, tag: str, wanted: str) -> bool:
    """Return whether an attribute matches (PS3.4 section C.2.2.2)."""
    if wanted in ("", "*"):
        return True
    tag = "00080060" if tag == "00080061" else tag  # ModalitiesInStudy is no attribute of an instance.
    value = _text(header, tag)
    try:
        representation = dictionary_VR(int(tag, 16))
    except KeyError:
        representation = "LO"
    if representation == "UI":
        return value in re.split(r"[,\\]", wanted)
    if representation in ("DA", "TM", "DT") and "-" in wanted:
        first, _, last = wanted.partition("-")
        return bool(value) and first <= value[: len(first) or None] and (not last or value[: len(last)] <= last)
    if representation == "PN":
        value, wanted = value.casefold(), wanted.casefold()
    pattern = re.escape(wanted).replace(r"\*", ".*").replace(r"\?", ".")
    return re.fullmatch(pattern, value, re.S) is not None


def _text(header: Json, tag: str | None) -> str:
    """Return the first value of an attribute as text; empty without a value."""
    values = header.get(tag or "", {}).get("Value") or [""]
    first = values[0]
    return str(first.get("Alphabetic", "") if isinstance(first, dict) else first)


def _grouped(stored: Iterable[StoredInstance], field: str) -> dict[str, list[StoredInstance]]:
    groups: dict[str, list[StoredInstance]] = {}
    for each in stored:
        groups.setdefault(getattr(each, field), []).append(each)
    return groups


def _chosen(header: Json, keywords: Iterable[str], search: _Search) -> Json:
    if search.include_all:
        return dict(header)
    tags = [tag for tag in map(_tag, keywords) if tag is not None]
    shown: Json = {}
    for tag in sorted({*tags, *search.include, *search.matches}):
        if tag in header:
            shown[tag] = header[tag]
        elif tag in tags:
            shown[tag] = {"vr": dictionary_VR(int(tag, 16))}
    return shown


def _page(results: list[Json], search: _Search) -> Response:
    page = results[search.offset : search.offset + search.limit]
    if not page:
        return Response(status_code=204)  # PS3.18 section 8.3.4.4.1
    headers = {}
    if len(results) > search.offset + len(page):
        headers["Warning"] = '299 fluoromap "There are more results; ask for them with offset."'
    return JSONResponse(page, headers=headers, media_type=DICOM_JSON)
