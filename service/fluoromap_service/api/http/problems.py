"""Errors as RFC 9457 problem documents with a stable code, without stack traces and patient data."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from sqlalchemy import select
from sqlalchemy.exc import DataError
from starlette.exceptions import HTTPException

from fluoromap_service.problem import Problem
from fluoromap_service.store.disk import FULL
from fluoromap_service.store.engine import DATABASE_AWAY, reading
from fluoromap_service.store.files import BrokenFile
from fluoromap_service.store.models import Instance

MEDIA_TYPE = "application/problem+json"

log = structlog.get_logger(__name__)


class ProblemDetail(BaseModel):
    """A place in the request that is wrong."""

    where: str = Field(
        description="Field path, 'row 7, column lat_ms' or a DICOM keyword.", examples=["row 7, column lat_ms"]
    )
    message: str = Field(description="What is wrong there and what to do.")


class ProblemDocument(BaseModel):
    """An RFC 9457 problem document."""

    type: str = Field(examples=["about:blank"])
    title: str = Field(examples=["Unprocessable Content"])
    status: int = Field(examples=[422])
    detail: str = Field(description="What is wrong and what to do.")
    code: str = Field(description="Stable name of the error.", examples=["no_ready_site"])
    errors: list[ProblemDetail] = Field(default_factory=list)


def document(problem: Problem) -> dict[str, Any]:
    """Return the problem as an RFC 9457 document."""
    return {
        "type": "about:blank",
        "title": HTTPStatus(problem.status).phrase,
        "status": problem.status,
        "detail": problem.detail,
        "code": problem.code,
        "errors": [{"where": where, "message": message} for where, message in problem.errors],
        **problem.extra,
    }


def answer(problem: Problem) -> JSONResponse:
    """Return the problem as an HTTP answer."""
    return JSONResponse(document(problem), problem.status, problem.headers, MEDIA_TYPE)


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI entries of the problems that a route may answer with."""
    return {
        status: {"model": ProblemDocument, "content": {MEDIA_TYPE: {}}, "description": HTTPStatus(status).phrase}
        for status in statuses
    }


def no_space() -> Problem:
    """Return the 507 for a disk that has no room left."""
    detail = "The disk of the service is nearly full; delete studies that nobody needs, or give it more space."
    return Problem(507, "no_space", detail)


_CODES = {
    400: "malformed",
    404: "not_found",
    405: "method_not_allowed",
    408: "request_timeout",
    413: "too_large",
    415: "unsupported_media_type",
}
"""Codes of errors that the framework raises."""


DATABASE_RETRY_SECONDS = 5


def database_away(error: Exception) -> Problem:
    """Return the 503 for a database that gave no answer.

    Log one line, without the address of the database.
    """
    log.warning("database_unavailable", error=type(error).__name__)
    return Problem(
        503, "database_unavailable", "The database does not answer or is locked; nothing was changed. Send the request again.",
        headers={"Retry-After": str(DATABASE_RETRY_SECONDS)},
    )  # fmt: skip


def install(app: FastAPI) -> None:
    """Make every error of the application a problem document."""

    @app.exception_handler(Problem)
    async def problem(request: Request, error: Problem) -> JSONResponse:
        return answer(error)

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> JSONResponse:
        code = _CODES.get(error.status_code, HTTPStatus(error.status_code).phrase.lower().replace(" ", "_"))
        return answer(Problem(error.status_code, code, str(error.detail), headers=error.headers))

    @app.exception_handler(RequestValidationError)
    async def validation(request: Request, error: RequestValidationError) -> JSONResponse:
        malformed = any(item["type"] == "json_invalid" for item in error.errors())
        bodiless = any(tuple(item["loc"]) == ("body",) for item in error.errors())
        media_type = request.headers.get("content-type", "").split(";")[0].strip().lower()
        if bodiless and not (media_type == "application/json" or media_type.endswith("+json")):
            return answer(Problem(415, "unsupported_media_type", "Send the body as application/json."))
        if bodiless and not await request.body():
            return answer(Problem(400, "malformed", "The request has no body; send JSON."))
        places = [
            (".".join(str(part) for part in item["loc"]), item["msg"].removeprefix("Value error, "))
            for item in error.errors()
        ]
        if malformed:
            return answer(
                Problem(400, "malformed", "The request body is not valid JSON; see 'errors' for the place.", places)
            )
        return answer(
            Problem(422, "invalid", "Some fields of the request are wrong; see 'errors' for each of them.", places)
        )

    @app.exception_handler(BrokenFile)
    def broken_file(request: Request, error: BrokenFile) -> JSONResponse:
        log.error("broken_file", sha256=error.sha256)
        with reading() as session:
            uid = session.scalar(select(Instance.sop_instance_uid).where(Instance.sha256 == error.sha256).limit(1))
        if uid is None:
            detail = "The stored file of this result is damaged. Start a new job; it computes the result again."
            return answer(Problem(409, "result_broken", detail))
        detail = "The stored file of this run is damaged. Upload the same file again; it replaces the damaged one."
        return answer(Problem(409, "run_broken", detail, [("sop_instance_uid", uid)]))

    @app.exception_handler(DataError)
    async def value_out_of_range(request: Request, error: DataError) -> JSONResponse:
        detail = "The request contains a NUL character or a number out of range; remove it."
        return answer(Problem(422, "invalid", detail))

    async def unavailable(request: Request, error: Exception) -> JSONResponse:
        return answer(database_away(error))

    for kind in DATABASE_AWAY:
        app.add_exception_handler(kind, unavailable)

    @app.exception_handler(OSError)
    async def disk_is_full(request: Request, error: OSError) -> JSONResponse:
        if error.errno not in FULL:
            raise error
        log.error("disk_full", path=getattr(request.scope.get("route"), "path", ""))
        return answer(no_space())
