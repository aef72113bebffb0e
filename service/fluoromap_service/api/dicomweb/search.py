"""QIDO-RS: searches for stored studies, series and instances (PS3.18 section 10.6)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
from fastapi import Request, Response
from pydicom.datadict import dictionary_VR
from sqlalchemy import ColumnElement, Select, func, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from fluoromap_service.api.dicomweb.accept import json_type
from fluoromap_service.api.dicomweb.addresses import instance_url, series_url, study_url
from fluoromap_service.api.dicomweb.descriptions import SEARCH_ANSWERS, search_parameters
from fluoromap_service.api.dicomweb.indexing import Scope, index_results, index_runs
from fluoromap_service.api.dicomweb.matching_rules import (
    AVAILABILITY,
    MODALITIES_IN_STUDY,
    ONLINE,
    PLACE_TAGS,
    SOP_CLASSES_IN_STUDY,
    conditions_of,
    places_of,
)
from fluoromap_service.api.dicomweb.search_parameters import Search, read_search, tag_of
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.dicom.indexed_header import LONGEST_ATTRIBUTE_BYTES
from fluoromap_service.store.engine import engine, reading
from fluoromap_service.store.models import DicomObject, DicomValue

router = new_router(
    "/dicom-web", tags=["dicomweb"], any_query_name=True, describe=search_parameters, responses=SEARCH_ANSWERS
)

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

_STUDY = (DicomObject.study_uid,)
_SERIES = (DicomObject.study_uid, DicomObject.series_uid)
_BETWEEN = " "
_INSTANCE = (DicomObject.study_uid, DicomObject.series_uid, DicomObject.uid)

Json = dict[str, Any]
Place = tuple[str, ...]
"""UIDs of a study; of a study and a series; or of these and an instance."""

_header_decoder = msgspec.json.Decoder(dict[str, msgspec.Raw])


class _Found:
    """The page of a search: for each result its place, and the header of its first matching object."""

    def __init__(self, search: Search, level: Sequence[InstrumentedAttribute[str]], media_type: str) -> None:
        self.search = search
        self.media_type = media_type
        self.level = level
        self.headers: dict[Place, dict[str, msgspec.Raw]] = {}
        self.has_more = False
        self.warnings: list[str] = []

    def count(self, *columns: ColumnElement[Any]) -> dict[Place, list[int]]:
        """Return numbers of objects for each result, whether they match or not."""
        query = select(*self.level, *columns).where(self._is_on_page()).group_by(*self.level)
        with reading() as session:
            rows = session.execute(query).all()
        length = len(self.level)
        return {tuple(row[:length]): [int(number) for number in row[length:]] for row in rows}

    def values(self, column: InstrumentedAttribute[str | None]) -> dict[Place, list[str]]:
        """Return the values of a column of all objects of each result, in order."""
        query = select(*self.level, column).where(self._is_on_page(), column.is_not(None)).distinct()
        with reading() as session:
            rows = session.execute(query.order_by(*self.level, column)).all()
        found: dict[Place, list[str]] = {}
        for row in rows:
            found.setdefault(tuple(row[:-1]), []).append(row[-1])
        return found

    def load(self, scope: Sequence[ColumnElement[bool]], conditions: Sequence[ColumnElement[bool]]) -> None:
        """Read the page; ``scope`` limits the search to a study or series."""
        with reading() as session:
            self._read_page(session, [*scope, *conditions])
            self._warn_of_unreadable_keys(session, scope)

    def _read_page(self, session: Session, conditions: Sequence[ColumnElement[bool]]) -> None:
        search = self.search
        # UIDs have digits and dots only, so that the texts have the order of the UIDs.
        first = func.min(DicomObject.series_uid + _BETWEEN + DicomObject.uid)
        groups: Select[*tuple[Any, ...]] = select(*self.level, first).group_by(*self.level)
        if self.level == _INSTANCE:
            # Each object is a group of its own; many of them take a database long.
            groups = select(*self.level, DicomObject.series_uid + _BETWEEN + DicomObject.uid)
        groups = groups.where(*conditions).order_by(*self.level)
        places = session.execute(groups.offset(search.offset).limit(search.limit + 1)).all()
        self.has_more = len(places) > search.limit
        uids = [place[-1].partition(_BETWEEN)[2] for place in places[: search.limit]]
        query = select(*self.level, DicomObject.header, DicomObject.unreadable).where(DicomObject.uid.in_(uids))
        rows = session.execute(query.order_by(*self.level)).all()
        # Somebody may have deleted an object meanwhile.
        self.headers = {tuple(row[: len(self.level)]): _header_decoder.decode(row.header) for row in rows}
        if unreadable := sum(row.unreadable > 0 for row in rows):
            self.warnings.append(f"{unreadable} of these results lack attributes that could not be read.")

    def _warn_of_unreadable_keys(self, session: Session, scope: Sequence[ColumnElement[bool]]) -> None:
        paths = {key.path for key in self.search.keys if not key.is_universal}
        if not paths:
            return
        query = select(func.count(DicomValue.object_id.distinct()))
        query = query.join(DicomObject, DicomObject.id == DicomValue.object_id)
        query = query.where(DicomValue.path.in_(["", *paths]), DicomValue.first.is_(None), *scope)
        if lacking := session.scalar(query):
            self.warnings.append(f"{lacking} objects have values of these attributes that could not be compared.")

    def _is_on_page(self) -> ColumnElement[bool]:
        places = list(self.headers)
        if len(self.level) == 1:
            return self.level[0].in_([place[0] for place in places])
        return tuple_(*self.level).in_(places)


@router.get("/studies")
def search_studies(request: Request, caller: Reader) -> Response:
    """Search for studies."""
    found = _searched(request, _STUDY, None, None)
    counts = found.count(func.count(DicomObject.series_uid.distinct()), func.count())
    modalities = found.values(DicomObject.modality)
    classes = found.values(DicomObject.sop_class_uid) if _is_asked(found.search, SOP_CLASSES_IN_STUDY) else {}
    results = []
    for place, header in found.headers.items():
        series, instances = counts.get(place, [0, 0])
        result = _chosen(header, STUDY_KEYWORDS, found.search) | {
            AVAILABILITY: {"vr": "CS", "Value": [ONLINE]},
            MODALITIES_IN_STUDY: {"vr": "CS", "Value": modalities.get(place, [])},
            "00081190": {"vr": "UR", "Value": [study_url(str(request.base_url), *place)]},
            "00201206": {"vr": "IS", "Value": [series]},
            "00201208": {"vr": "IS", "Value": [instances]},
        }
        if place in classes:
            result[SOP_CLASSES_IN_STUDY] = {"vr": "UI", "Value": classes[place]}
        results.append(result)
    return _page(results, found)


@router.get("/series")
def search_all_series(request: Request, caller: Reader) -> Response:
    """Search for series of all studies."""
    return _series(request, None, (*STUDY_KEYWORDS, *SERIES_KEYWORDS))


@router.get("/studies/{study_uid}/series")
def search_series(study_uid: str, request: Request, caller: Reader) -> Response:
    """Search for series of one study."""
    return _series(request, study_uid, ("StudyInstanceUID", *SERIES_KEYWORDS))


def _series(request: Request, study_uid: str | None, keywords: tuple[str, ...]) -> Response:
    found = _searched(request, _SERIES, study_uid, None)
    counts = found.count(func.count())
    results = []
    for place, header in found.headers.items():
        study, series = place
        result = _chosen(header, keywords, found.search) | {
            "00081190": {"vr": "UR", "Value": [series_url(str(request.base_url), study, series)]},
            "00201209": {"vr": "IS", "Value": counts.get(place, [0])},
        }
        results.append(result)
    return _page(results, found)


@router.get("/instances")
def search_all_instances(request: Request, caller: Reader) -> Response:
    """Search for instances of all studies."""
    return _instances(request, None, None, (*STUDY_KEYWORDS, *SERIES_KEYWORDS, *INSTANCE_KEYWORDS))


@router.get("/studies/{study_uid}/instances")
def search_instances_of_study(study_uid: str, request: Request, caller: Reader) -> Response:
    """Search for instances of one study."""
    return _instances(request, study_uid, None, ("StudyInstanceUID", *SERIES_KEYWORDS, *INSTANCE_KEYWORDS))


@router.get("/studies/{study_uid}/series/{series_uid}/instances")
def search_instances(study_uid: str, series_uid: str, request: Request, caller: Reader) -> Response:
    """Search for instances of one series."""
    return _instances(request, study_uid, series_uid, ("StudyInstanceUID", "SeriesInstanceUID", *INSTANCE_KEYWORDS))


def _instances(request: Request, study_uid: str | None, series_uid: str | None, keywords: tuple[str, ...]) -> Response:
    found = _searched(request, _INSTANCE, study_uid, series_uid)
    results = []
    for (study, series, uid), header in found.headers.items():
        result = _chosen(header, keywords, found.search) | {
            "00081190": {"vr": "UR", "Value": [instance_url(str(request.base_url), study, series, uid)]},
            AVAILABILITY: {"vr": "CS", "Value": [ONLINE]},
        }
        results.append(result)
    return _page(results, found)


def _searched(
    request: Request, level: Sequence[InstrumentedAttribute[str]], study_uid: str | None, series_uid: str | None
) -> _Found:
    """Read the parameters and the page of a search.

    It completes the index first, where the search needs that.

    Raises
    ------
    Problem
        422 as :func:`read_search` and :func:`conditions_of`; 406 ``not_acceptable``; 503 ``indexing``.
    """
    search = read_search(request.query_params.multi_items())
    found = _Found(search, level, json_type(request))
    if search.is_fuzzy:
        found.warnings.append("The fuzzymatching parameter is not supported. Only literal matching has been performed.")
    conditions = conditions_of(search.keys, engine().dialect.name)
    places = places_of(search.keys)
    scope = []
    for column, tag, wanted in zip(_INSTANCE, PLACE_TAGS, (study_uid, series_uid, None), strict=True):
        if wanted is not None:
            scope.append(column == wanted)
            places[tag] = [wanted]
    index_runs(Scope(*(places.get(tag) for tag in PLACE_TAGS)))
    if study_uid is not None and (lost := index_results(study_uid)):
        found.warnings.append(f"The results of {lost} jobs of this study cannot be listed.")
    found.load(scope, conditions)
    return found


def _is_asked(search: Search, tag: str) -> bool:
    return tag in search.include or any(key.path == tag for key in search.keys)


def _chosen(header: dict[str, msgspec.Raw], keywords: Iterable[str], search: Search) -> Json:
    if search.include_all:
        return {tag: element for tag, element in header.items() if len(element) <= LONGEST_ATTRIBUTE_BYTES}
    tags = {tag for tag in map(tag_of, keywords) if tag is not None}
    shown: Json = {}
    for tag in {*tags, *search.include, *(key.path.partition(".")[0] for key in search.keys)}:
        if tag in header and len(header[tag]) <= LONGEST_ATTRIBUTE_BYTES:
            shown[tag] = header[tag]
        elif tag in tags:
            shown[tag] = {"vr": dictionary_VR(int(tag, 16))}
    return shown


def _page(results: list[Json], found: _Found) -> Response:
    warnings = list(found.warnings)
    if found.has_more and results:
        warnings.append("There are more results; ask for them with offset.")
    headers = {"Warning": ", ".join(f'299 fluoromap "{warning}"' for warning in warnings)} if warnings else None
    if not results:
        return Response(status_code=204, headers=headers)  # PS3.18 section 8.3.4.4.1
    return Response(
        msgspec.json.encode([dict(sorted(result.items())) for result in results]),
        headers=headers,
        media_type=found.media_type,
    )
