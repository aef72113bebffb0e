"""The words of the OpenAPI document about the DICOMweb routes: media types of bodies and answers, and query parameters."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Query

from fluoromap_service.api.dicomweb.accept import DICOM_JSON
from fluoromap_service.api.http.problems import responses

Described = dict[int | str, dict[str, Any]]

_BINARY = {"type": "string", "format": "binary"}
_HEADER = {"type": "object", "description": "A header in the DICOM JSON model (PS3.18 annex F)."}


def _of_kinds(schema: dict[str, Any], *kinds: str) -> dict[str, Any]:
    return {kind: {"schema": schema} for kind in kinds}


def related_answers(kind: str, description: str) -> Described:
    """Return the answers of a route that sends parts of a media type."""
    content = _of_kinds(_BINARY, "multipart/related", kind)
    return {200: {"content": content, "description": description}, **responses(400, 401, 403, 404, 406, 409, 422, 429)}


def _headers(description: str) -> dict[str, Any]:
    content = _of_kinds({"type": "array", "items": _HEADER}, DICOM_JSON, "application/json")
    return {"content": content, "description": description}


METADATA_ANSWERS: Described = {200: _headers("The headers."), **responses(401, 403, 404, 406, 409, 422, 429)}
SEARCH_ANSWERS: Described = {
    200: _headers("The attributes of each match."),
    204: {"description": "Nothing matches."},
    **responses(401, 403, 406, 409, 422, 429),
}
RENDERED_ANSWERS: Described = {
    200: {"content": _of_kinds(_BINARY, "image/jpeg", "image/png"), "description": "The picture."},
    **responses(400, 401, 403, 404, 406, 409, 422, 429),
}
STORE_ANSWERS: Described = {
    200: {"content": _of_kinds(_HEADER, DICOM_JSON), "description": "All runs are stored."},
    202: {"content": _of_kinds(_HEADER, DICOM_JSON), "description": "Some runs are stored; FailedSOPSequence has the others."},
    **responses(400, 401, 403, 409, 413, 415, 422, 429),
}  # fmt: skip
STORE_BODY = {"requestBody": {"required": True, "content": _of_kinds(_BINARY, "multipart/related")}}


def search_parameters(
    limit: Annotated[str | None, Query(description="Most matches to return, at most 500.", examples=["100"])] = None,
    offset: Annotated[str | None, Query(description="Matches to pass over.", examples=["0"])] = None,
    includefield: Annotated[
        str | None,
        Query(
            description="Further attributes to return, by keyword or tag, with commas between; or all.",
            examples=["all"],
        ),
    ] = None,
    fuzzymatching: Annotated[str | None, Query(description="Has no effect.", examples=["false"])] = None,
) -> None:
    """Describe the parameters of a search that are no attributes; the search reads them itself."""


def rendered_parameters(
    accept: Annotated[str | None, Query(description="Counts before the Accept header.", examples=["image/png"])] = None,
    window: Annotated[
        str | None,
        Query(
            description="Centre, width and function: linear, linear-exact or sigmoid.", examples=["2048,4096,linear"]
        ),
    ] = None,
    viewport: Annotated[
        str | None,
        Query(
            description="Width and height of the picture, and left, top, width and height of a region.",
            examples=["512,512"],
        ),
    ] = None,
    quality: Annotated[str | None, Query(description="Quality of a JPEG, 1 to 100.", examples=["90"])] = None,
) -> None:
    """Describe the parameters of a rendered frame; the route reads them itself."""
