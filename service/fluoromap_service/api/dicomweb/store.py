"""STOW-RS: runs of a multipart/related request, written to disk while they arrive (PS3.18 section 10.5)."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from fastapi import Request
from fastapi.responses import JSONResponse
from python_multipart.multipart import parse_options_header
from starlette.requests import ClientDisconnect

from fluoromap_service.api.dicomweb.accept import DICOM_JSON
from fluoromap_service.api.dicomweb.addresses import instance_url, study_url
from fluoromap_service.api.dicomweb.descriptions import STORE_ANSWERS, STORE_BODY
from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.multipart import MultipartBody, malformed
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Writer
from fluoromap_service.api.study.uploads import ArrivingPart, Part, arriving_file, in_upload_thread, write_all
from fluoromap_service.dicom import InstanceFacts
from fluoromap_service.dicom.indexed_header import read_run
from fluoromap_service.dicom.reading import read_instance_uids
from fluoromap_service.dicom.store_statuses import status_of
from fluoromap_service.problem import Problem
from fluoromap_service.store.audit import Act
from fluoromap_service.store.engine import writing
from fluoromap_service.study.arrivals import add_arrival

router = new_router("/dicom-web", tags=["dicomweb"], responses=STORE_ANSWERS)

Json = dict[str, Any]


class _RelatedParts(MultipartBody):
    """A body of DICOM files, one in each part."""

    def __init__(self, boundary: bytes | None, stack: ExitStack) -> None:
        super().__init__(boundary)
        self._stack = stack
        self._arriving: ArrivingPart | None = None
        self.parts: list[Part] = []

    def begin_part(self, headers: dict[bytes, bytes]) -> None:
        if parse_options_header(headers.get(b"content-type"))[0] != b"application/dicom":
            raise Problem(
                415,
                "unsupported_media_type",
                "A part has another content type, or none; send parts of application/dicom.",
            )
        self._arriving = arriving_file(self._stack, None)

    def add(self, data: bytes) -> None:
        if self._arriving is not None:
            self._arriving.write(data)

    def end_part(self) -> None:
        if self._arriving is not None:
            self.parts.append(self._arriving.finish())
        self._arriving = None


@router.post("/studies", openapi_extra=STORE_BODY)
async def store_instances(request: Request, caller: Writer) -> JSONResponse:
    """Store runs; each joins the mapping study of its DICOM study.

    When all runs fail, the status is 409 and the answer has FailedSOPSequence as with 202.
    """
    return await _store_all(request, caller, None)


@router.post("/studies/{study_uid}", openapi_extra=STORE_BODY)
async def store_instances_of_study(study_uid: str, request: Request, caller: Writer) -> JSONResponse:
    """Store runs of one DICOM study; further as without its UID."""
    return await _store_all(request, caller, study_uid)


async def _store_all(request: Request, caller: str, study_uid: str | None) -> JSONResponse:
    kind, options = parse_options_header(request.headers.get("content-type"))
    if kind != b"multipart/related" or options.get(b"type", b"application/dicom").lower() != b"application/dicom":
        detail = 'Send the runs as multipart/related with type="application/dicom".'
        raise Problem(415, "unsupported_media_type", detail)
    with ExitStack() as stack:
        body = _RelatedParts(options.get(b"boundary"), stack)
        try:
            await write_all(request, body.write)
        except ClientDisconnect:
            raise Problem(400, "truncated", "The connection ended before the body; send the request again.") from None
        body.check_end()
        if not body.parts:
            raise malformed("The body has no part between its boundaries; send each run as a part.")
        return await in_upload_thread(_answer, body.parts, caller, study_uid, str(request.base_url))


def _answer(parts: list[Part], caller: str, study_uid: str | None, base: str) -> JSONResponse:
    """Store the parts and return the Store Instances Response Module (PS3.18 annex I)."""
    stored: list[Json] = []
    failed: list[Json] = []
    studies = set()
    for part in parts:
        facts: InstanceFacts | None = None
        try:
            # A hostile file can crash a decoder, so another process reads it.
            run = run_in_pool(Task.READ_FILE, read_run, part.path)
            facts = run.facts
            if study_uid not in (None, facts.study_instance_uid):
                raise Problem(422, "not_xa", "The run is of another DICOM study than the address; send it to its own.")
            with writing() as session:
                add_arrival(session, part.path, run, part.sha256, Act(caller, "STOW-RS"))
        except Problem as problem:
            # A part that takes too long must not hold up the others at each attempt.
            if problem.status in (429, 503) and problem.code != "too_slow":
                raise
            failed.append(
                _failed_reference(part, facts) | {"00081197": {"vr": "US", "Value": [int(status_of(problem))]}}
            )
        else:
            url = instance_url(base, facts.study_instance_uid, facts.series_instance_uid, facts.sop_instance_uid)
            stored.append(
                _reference(facts.sop_class_uid, facts.sop_instance_uid) | {"00081190": {"vr": "UR", "Value": [url]}}
            )
            studies.add(facts.study_instance_uid)
    answer: Json = {}
    if len(studies) == 1:
        answer["00081190"] = {"vr": "UR", "Value": [study_url(base, studies.pop())]}
    if failed:
        answer["00081198"] = {"vr": "SQ", "Value": failed}
    if stored:
        answer["00081199"] = {"vr": "SQ", "Value": stored}
    status = 200 if not failed else 202 if stored else 409
    return JSONResponse(answer, status, media_type=DICOM_JSON)


def _failed_reference(part: Part, facts: InstanceFacts | None) -> Json:
    """Return the readable UIDs of a part that is not stored."""
    if facts is not None:
        return _reference(facts.sop_class_uid, facts.sop_instance_uid)
    try:
        return _reference(*run_in_pool(Task.READ_FILE, read_instance_uids, part.path))
    except Problem:
        return {}


def _reference(sop_class_uid: str | None, sop_instance_uid: str | None) -> Json:
    uids = {"00081150": sop_class_uid, "00081155": sop_instance_uid}
    return {tag: {"vr": "UI", "Value": [uid]} for tag, uid in uids.items() if uid is not None}
