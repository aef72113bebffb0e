"""WADO-RS: runs and results, their headers and their frames (PS3.18 section 10.4)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from fluoromap_service.api.dicomweb.accept import Form, answer_form, json_type
from fluoromap_service.api.dicomweb.descriptions import METADATA_ANSWERS, related_answers
from fluoromap_service.api.dicomweb.stored import StoredInstance, existing, metadata_of_all
from fluoromap_service.api.http.middleware.download_limit import LARGE_DOWNLOAD
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.problem import Problem, not_found

router = new_router("/dicom-web", tags=["dicomweb"])

_BOUNDARY = "fluoromap-part-7d2f4c9e81b34a06"
_DICOM, _PIXELS = "application/dicom", "application/octet-stream"
_EXPLICIT_LITTLE_ENDIAN = "1.2.840.10008.1.2.1"
_FILE_ANSWERS = related_answers(_DICOM, "The files.")


@router.get("/studies/{study_uid}/metadata", response_class=Response, responses=METADATA_ANSWERS)
def study_metadata(study_uid: str, request: Request, caller: Reader) -> Response:
    """Return the headers of a study."""
    return _metadata(request, existing(study_uid))


@router.get("/studies/{study_uid}/series/{series_uid}/metadata", response_class=Response, responses=METADATA_ANSWERS)
def series_metadata(study_uid: str, series_uid: str, request: Request, caller: Reader) -> Response:
    """Return the headers of a series."""
    return _metadata(request, existing(study_uid, series_uid))


@router.get(
    "/studies/{study_uid}/series/{series_uid}/instances/{uid}/metadata",
    response_class=Response,
    responses=METADATA_ANSWERS,
)
def instance_metadata(study_uid: str, series_uid: str, uid: str, request: Request, caller: Reader) -> Response:
    """Return the header of an instance."""
    return _metadata(request, existing(study_uid, series_uid, uid))


def _metadata(request: Request, instances: list[StoredInstance]) -> Response:
    media_type = json_type(request)
    return Response(b"[" + b",".join(metadata_of_all(instances)) + b"]", media_type=media_type)


@router.get("/studies/{study_uid}", response_class=Response, responses=_FILE_ANSWERS, dependencies=[LARGE_DOWNLOAD])
def retrieve_study(study_uid: str, request: Request, caller: Reader) -> StreamingResponse:
    """Return the files of a study."""
    return _files(request, existing(study_uid))


@router.get(
    "/studies/{study_uid}/series/{series_uid}",
    response_class=Response,
    responses=_FILE_ANSWERS,
    dependencies=[LARGE_DOWNLOAD],
)
def retrieve_series(study_uid: str, series_uid: str, request: Request, caller: Reader) -> StreamingResponse:
    """Return the files of a series."""
    return _files(request, existing(study_uid, series_uid))


@router.get(
    "/studies/{study_uid}/series/{series_uid}/instances/{uid}",
    response_class=Response,
    responses=_FILE_ANSWERS,
    dependencies=[LARGE_DOWNLOAD],
)
def retrieve_instance(study_uid: str, series_uid: str, uid: str, request: Request, caller: Reader) -> StreamingResponse:
    """Return the file of an instance."""
    return _files(request, existing(study_uid, series_uid, uid))


def _files(request: Request, instances: list[StoredInstance]) -> StreamingResponse:
    """Return files as they are stored.

    A request for another transfer syntax is refused.
    """
    form = answer_form(request, _DICOM, [instance.transfer_syntax for instance in instances])
    for instance in instances:
        instance.make_file()
    if form is Form.SINGLE:
        (instance,) = instances
        return StreamingResponse(instance.chunks(), media_type=_with_syntax(_DICOM, instance.transfer_syntax))

    def parts() -> Iterator[tuple[str, Iterator[bytes]]]:
        for instance in instances:
            yield _with_syntax(_DICOM, instance.transfer_syntax), instance.chunks()

    return _related(_DICOM, parts())


def _with_syntax(kind: str, syntax: str) -> str:
    return f"{kind}; transfer-syntax={syntax}"


@router.get(
    "/studies/{study_uid}/series/{series_uid}/instances/{uid}/frames/{numbers}",
    response_class=Response,
    responses=related_answers(_PIXELS, "The frames, uncompressed."),
)
def retrieve_frames(
    study_uid: str, series_uid: str, uid: str, numbers: str, request: Request, caller: Reader
) -> Response:
    """Return frames, uncompressed and little endian.

    The numbers count from 1, with commas between.
    """
    (instance,) = existing(study_uid, series_uid, uid)
    if not re.fullmatch(r"[0-9]{1,5}(,[0-9]{1,5})*", numbers):
        raise Problem(400, "malformed", "The frames are no list of numbers; write them as in frames/1,2,3.")
    wanted = [int(number) for number in numbers.split(",")]
    if len(wanted) > max(instance.frames, 1):
        raise Problem(400, "malformed", "The list has more frames than the instance; name each frame once.")
    form = answer_form(request, _PIXELS, [_EXPLICIT_LITTLE_ENDIAN] * len(wanted))
    if not all(1 <= number <= instance.frames for number in wanted):
        raise not_found("frame")
    kind = _with_syntax(_PIXELS, _EXPLICIT_LITTLE_ENDIAN)
    # The first frame now, so that a damaged file has an error for its answer.
    first = instance.frame(wanted[0] - 1)
    if form is Form.SINGLE:
        return Response(first, media_type=kind)

    def parts() -> Iterator[tuple[str, Iterator[bytes]]]:
        yield kind, iter([first])
        for number in wanted[1:]:
            yield kind, iter([instance.frame(number - 1)])

    return _related(_PIXELS, parts())


def _related(kind: str, parts: Iterable[tuple[str, Iterator[bytes]]]) -> StreamingResponse:
    def body() -> Iterator[bytes]:
        for content_type, chunks in parts:
            yield f"--{_BOUNDARY}\r\nContent-Type: {content_type}\r\n\r\n".encode()
            yield from chunks
            yield b"\r\n"
        yield f"--{_BOUNDARY}--\r\n".encode()

    return StreamingResponse(body(), media_type=f'multipart/related; type="{kind}"; boundary={_BOUNDARY}')
