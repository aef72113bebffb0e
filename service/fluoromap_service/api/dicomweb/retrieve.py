"""WADO-RS: runs and results, their headers and their frames (PS3.18 section 10.4)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from fastapi import Request
from fastapi.responses import Response, StreamingResponse

from fluoromap_service.api.dicomweb.accept import accepted_types, asked_syntaxes, not_acceptable
from fluoromap_service.api.dicomweb.store import DICOM_JSON
from fluoromap_service.api.dicomweb.stored import StoredInstance, existing, metadata_of_all
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.problem import Problem, not_found

router = new_router("/dicom-web", include_in_schema=False)

_BOUNDARY = "fluoromap-part-7d2f4c9e81b34a06"
_EXPLICIT_LITTLE_ENDIAN = "1.2.840.10008.1.2.1"


@router.get("/studies/{study_uid}/metadata")
def study_metadata(study_uid: str, request: Request, caller: Reader) -> Response:
    """Return the headers of a study."""
    return _metadata(request, existing(study_uid))


@router.get("/studies/{study_uid}/series/{series_uid}/metadata")
def series_metadata(study_uid: str, series_uid: str, request: Request, caller: Reader) -> Response:
    """Return the headers of a series."""
    return _metadata(request, existing(study_uid, series_uid))


@router.get("/studies/{study_uid}/series/{series_uid}/instances/{uid}/metadata")
def instance_metadata(study_uid: str, series_uid: str, uid: str, request: Request, caller: Reader) -> Response:
    """Return the header of an instance."""
    return _metadata(request, existing(study_uid, series_uid, uid))


def _metadata(request: Request, instances: list[StoredInstance]) -> Response:
    accepted_types(request, DICOM_JSON, "application/json")
    return Response(b"[" + b",".join(metadata_of_all(instances)) + b"]", media_type=DICOM_JSON)


@router.get("/studies/{study_uid}")
def retrieve_study(study_uid: str, request: Request, caller: Reader) -> StreamingResponse:
    """Return the files of a study."""
    return _files(request, existing(study_uid))


@router.get("/studies/{study_uid}/series/{series_uid}")
def retrieve_series(study_uid: str, series_uid: str, request: Request, caller: Reader) -> StreamingResponse:
    """Return the files of a series."""
    return _files(request, existing(study_uid, series_uid))


@router.get("/studies/{study_uid}/series/{series_uid}/instances/{uid}")
def retrieve_instance(study_uid: str, series_uid: str, uid: str, request: Request, caller: Reader) -> StreamingResponse:
    """Return the file of an instance."""
    return _files(request, existing(study_uid, series_uid, uid))


def _files(request: Request, instances: list[StoredInstance]) -> StreamingResponse:
    """Return files as they are stored.

    A request for another transfer syntax is refused.
    """
    asked = asked_syntaxes(accepted_types(request, "multipart/related", "application/dicom"))
    for instance in instances:
        if asked and not asked & {"*", instance.transfer_syntax}:
            raise not_acceptable("The file is stored in another transfer syntax; ask for transfer-syntax=*.")
    for instance in instances:
        instance.make_file()

    def parts() -> Iterator[tuple[str, Iterator[bytes]]]:
        for instance in instances:
            yield f"application/dicom; transfer-syntax={instance.transfer_syntax}", instance.chunks()

    return _related("application/dicom", parts())


@router.get("/studies/{study_uid}/series/{series_uid}/instances/{uid}/frames/{numbers}")
def retrieve_frames(
    study_uid: str, series_uid: str, uid: str, numbers: str, request: Request, caller: Reader
) -> StreamingResponse:
    """Return frames, uncompressed and little endian.

    The numbers count from 1, with commas between.
    """
    asked = asked_syntaxes(accepted_types(request, "multipart/related", "application/octet-stream"))
    if asked and not asked & {"*", _EXPLICIT_LITTLE_ENDIAN}:
        raise not_acceptable("Frames are sent uncompressed; ask for Explicit VR Little Endian.")
    (instance,) = existing(study_uid, series_uid, uid)
    if not re.fullmatch(r"[0-9]{1,5}(,[0-9]{1,5})*", numbers):
        raise Problem(400, "malformed", "The frames are no list of numbers; write them as in frames/1,2,3.")
    wanted = [int(number) for number in numbers.split(",")]
    if not all(1 <= number <= instance.frames for number in wanted):
        raise not_found("frame")
    # The first frame now, so that a damaged file has an error for its answer.
    first = instance.frame(wanted[0] - 1)

    def parts() -> Iterator[tuple[str, Iterator[bytes]]]:
        kind = f"application/octet-stream; transfer-syntax={_EXPLICIT_LITTLE_ENDIAN}"
        yield kind, iter([first])
        for number in wanted[1:]:
            yield kind, iter([instance.frame(number - 1)])

    return _related("application/octet-stream", parts())


def _related(kind: str, parts: Iterable[tuple[str, Iterator[bytes]]]) -> StreamingResponse:
    def body() -> Iterator[bytes]:
        for content_type, chunks in parts:
            yield f"--{_BOUNDARY}\r\nContent-Type: {content_type}\r\n\r\n".encode()
            yield from chunks
            yield b"\r\n"
        yield f"--{_BOUNDARY}--\r\n".encode()

    return StreamingResponse(body(), media_type=f'multipart/related; type="{kind}"; boundary={_BOUNDARY}')
