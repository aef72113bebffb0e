"""WADO-RS: stored instances, their headers and their frames (PS3.18 section 10.4)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, StreamingResponse

from fluoromap_service.api.dicomweb.store import DICOM_JSON
from fluoromap_service.api.dicomweb.stored import StoredInstance, existing
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.security import Reader
from fluoromap_service.dicom.frames import frame_bytes
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store.files import CHUNK_BYTES

router = APIRouter(prefix="/dicom-web", include_in_schema=False)

_BOUNDARY = "fluoromap-part-7d2f4c9e81b34a06"
_EXPLICIT_LITTLE_ENDIAN = "1.2.840.10008.1.2.1"


@router.get("/studies/{study_uid}/metadata")
def study_metadata(study_uid: str, request: Request, caller: Reader) -> JSONResponse:
    """Return the headers of a study."""
    return _metadata(request, existing(study_uid))


@router.get("/studies/{study_uid}/series/{series_uid}/metadata")
def series_metadata(study_uid: str, series_uid: str, request: Request, caller: Reader) -> JSONResponse:
    """Return the headers of a series."""
    return _metadata(request, existing(study_uid, series_uid))


@router.get("/studies/{study_uid}/series/{series_uid}/instances/{uid}/metadata")
def instance_metadata(study_uid: str, series_uid: str, uid: str, request: Request, caller: Reader) -> JSONResponse:
    """Return the header of an instance."""
    return _metadata(request, existing(study_uid, series_uid, uid))


def _metadata(request: Request, runs: list[StoredInstance]) -> JSONResponse:
    _check(request, DICOM_JSON, "application/json")
    return JSONResponse([run.header for run in runs], media_type=DICOM_JSON)


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


def _files(request: Request, runs: list[StoredInstance]) -> StreamingResponse:
    """Return files as they are stored.

    A request for another transfer syntax is refused.
    """
    asked = _asked_syntaxes(_check(request, "multipart/related", "application/dicom"))
    for run in runs:
        if asked and not asked & {"*", run.facts.transfer_syntax}:
            raise _not_acceptable("The run is stored in another transfer syntax; ask for transfer-syntax=*.")
    paths = [(run.path, run.facts.transfer_syntax) for run in runs]

    def parts() -> Iterator[tuple[str, Iterator[bytes]]]:
        for path, syntax in paths:
            with path.open("rb") as stream:
                yield f"application/dicom; transfer-syntax={syntax}", iter(lambda: stream.read(CHUNK_BYTES), b"")

    return _related("application/dicom", parts())


@router.get("/studies/{study_uid}/series/{series_uid}/instances/{uid}/frames/{numbers}")
def retrieve_frames(
    study_uid: str, series_uid: str, uid: str, numbers: str, request: Request, caller: Reader
) -> StreamingResponse:
    """Return frames, uncompressed and little endian.

    The numbers count from 1, with commas between.
    """
    asked = _asked_syntaxes(_check(request, "multipart/related", "application/octet-stream"))
    if asked and not asked & {"*", _EXPLICIT_LITTLE_ENDIAN}:
        raise _not_acceptable("Frames are sent uncompressed; ask for Explicit VR Little Endian.")
    (run,) = existing(study_uid, series_uid, uid)
    if not re.fullmatch(r"[0-9]{1,5}(,[0-9]{1,5})*", numbers):
        raise Problem(400, "malformed", "The frames are no list of numbers; write them as in frames/1,2,3.")
    wanted = [int(number) for number in numbers.split(",")]
    if not all(1 <= number <= run.facts.frames for number in wanted):
        raise not_found("frame")
    path = run.path
    # The first frame now, so that a damaged file has an error for its answer.
    first = run_in_pool(Task.DRAW_PICTURE, frame_bytes, path, run.facts, wanted[0] - 1)

    def parts() -> Iterator[tuple[str, Iterator[bytes]]]:
        kind = f"application/octet-stream; transfer-syntax={_EXPLICIT_LITTLE_ENDIAN}"
        yield kind, iter([first])
        for number in wanted[1:]:
            yield kind, iter([run_in_pool(Task.DRAW_PICTURE, frame_bytes, path, run.facts, number - 1)])

    return _related("application/octet-stream", parts())


def _check(request: Request, *kinds: str) -> list[str]:
    """Check the parameters and the Accept header, and return its fitting items.

    A request has no parameters and accepts one of the media types.

    Raises
    ------
    Problem
        406 ``not_acceptable`` or 422 ``unknown_parameter``.
    """
    accepted = [item for item in request.headers.get("accept", "*/*").lower().split(",") if _fits(item, kinds)]
    if not accepted:
        raise _not_acceptable(f"This address answers with {kinds[-1]}; change the Accept header.")
    if request.query_params:
        detail = "This address has no query parameters; leave them out."
        raise Problem(422, "unknown_parameter", detail, [(f"query.{name}", "unknown") for name in request.query_params])
    return accepted


def _fits(item: str, kinds: tuple[str, ...]) -> bool:
    """Return whether an item of an Accept header allows one of the media types."""
    kind = item.split(";")[0].strip()
    if kind not in ("*/*", *kinds, *(f"{each.split('/')[0]}/*" for each in kinds)):
        return False
    parts = re.search(r'[; ]type="?([^";]+)', item)
    return parts is None or parts[1].strip() in ("*/*", *kinds)


def _asked_syntaxes(accepted: list[str]) -> set[str]:
    """Return the transfer syntaxes of an Accept header, ``*`` for any.

    The set is empty when an item names none.
    """
    asked = [re.findall(r'transfer-syntax="?([0-9.*]+)', item) for item in accepted]
    return set() if [] in asked else {syntax for found in asked for syntax in found}


def _not_acceptable(detail: str) -> Problem:
    return Problem(406, "not_acceptable", detail)


def _related(kind: str, parts: Iterable[tuple[str, Iterator[bytes]]]) -> StreamingResponse:
    def body() -> Iterator[bytes]:
        for content_type, chunks in parts:
            yield f"--{_BOUNDARY}\r\nContent-Type: {content_type}\r\n\r\n".encode()
            yield from chunks
            yield b"\r\n"
        yield f"--{_BOUNDARY}--\r\n".encode()

    return StreamingResponse(body(), media_type=f'multipart/related; type="{kind}"; boundary={_BOUNDARY}')
