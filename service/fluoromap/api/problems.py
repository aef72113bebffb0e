"""Errors as RFC 9457 problem documents with a stable code. No stack trace and no patient data ever stands in one."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from sqlalchemy.exc import DataError
from starlette.exceptions import HTTPException

from fluoromap.store.refused import Refused

MEDIA_TYPE = "application/problem+json"

log = structlog.get_logger(__name__)


class ProblemDetail(BaseModel):
    """One place in the request that is wrong."""

    where: str = Field(
        description="Field path, 'row 7, column lat_ms' or a DICOM keyword.", examples=["row 7, column lat_ms"]
    )
    message: str = Field(description="What is wrong there and what to do.")


class ProblemDocument(BaseModel):
    """RFC 9457 problem document."""

    type: str = Field(examples=["about:blank"])
    title: str = Field(examples=["Unprocessable Content"])
    status: int = Field(examples=[422])
    detail: str = Field(description="A sentence that says what to do.")
    code: str = Field(description="Stable name of the error.", examples=["no_ready_site"])
    errors: list[ProblemDetail] = Field(default_factory=list)


class Problem(Refused):
    """A refusal as the client sees it: any status, and headers of its own.

    Parameters
    ----------
    status, code, detail, errors, extra
        As for :class:`fluoromap.store.refused.Refused`.
    headers : mapping, optional
        Further headers of the answer.
    """

    def __init__(
        self,
        status: int,
        code: str,
        detail: str,
        errors: list[tuple[str, str]] | None = None,
        *,
        headers: Mapping[str, str] | None = None,
        extra: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(status, code, detail, errors, extra)
        self.headers = dict(headers or {})

    @classmethod
    def of(cls, refused: Refused) -> Problem:
        """The problem that tells a refusal of the store."""
        if isinstance(refused, Problem):
            return refused
        return cls(refused.status, refused.code, refused.detail, refused.errors, extra=refused.extra)

    def document(self) -> dict[str, Any]:
        return {
            "type": "about:blank",
            "title": HTTPStatus(self.status).phrase,
            "status": self.status,
            "detail": self.detail,
            "code": self.code,
            "errors": [{"where": where, "message": message} for where, message in self.errors],
            **self.extra,
        }

    def response(self) -> JSONResponse:
        return JSONResponse(self.document(), self.status, self.headers, MEDIA_TYPE)


def not_found(what: str) -> Problem:
    """404 for a resource that does not exist (or that the caller may not know of)."""
    return Problem(404, "not_found", f"There is no such {what}.")


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries for the problems a route may answer with."""
    return {
        status: {"model": ProblemDocument, "content": {MEDIA_TYPE: {}}, "description": HTTPStatus(status).phrase}
        for status in statuses
    }


_CODES = {400: "malformed", 404: "not_found", 405: "method_not_allowed", 415: "unsupported_media_type"}


def install(app: FastAPI) -> None:
    """Make every error of the application a problem document."""

    @app.exception_handler(Refused)
    async def refused(request: Request, error: Refused) -> JSONResponse:
        return Problem.of(error).response()

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> JSONResponse:
        code = _CODES.get(error.status_code, HTTPStatus(error.status_code).phrase.lower().replace(" ", "_"))
        return Problem(error.status_code, code, str(error.detail), headers=error.headers).response()

    @app.exception_handler(RequestValidationError)
    async def validation(request: Request, error: RequestValidationError) -> JSONResponse:
        malformed = any(item["type"] == "json_invalid" for item in error.errors())
        bodiless = any(tuple(item["loc"]) == ("body",) for item in error.errors())
        media_type = request.headers.get("content-type", "").split(";")[0].strip().lower()
        if bodiless and not (media_type == "application/json" or media_type.endswith("+json")):
            return Problem(415, "unsupported_media_type", "Send the body as application/json.").response()
        if bodiless and not await request.body():
            return Problem(400, "malformed", "The request has no body.").response()
        places = [
            (".".join(str(part) for part in item["loc"]), item["msg"].removeprefix("Value error, "))
            for item in error.errors()
        ]
        if malformed:
            return Problem(400, "malformed", "The request body is not valid JSON.", places).response()
        return Problem(422, "invalid", "Some fields of the request are wrong.", places).response()

    @app.exception_handler(DataError)
    async def unstorable(request: Request, error: DataError) -> JSONResponse:
        detail = "The request holds a value that cannot be kept: a NUL character, or a number out of range."
        return Problem(422, "invalid", detail).response()

    @app.exception_handler(Exception)
    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        log.error(
            "unexpected_error", error=type(error).__name__, path=request.scope.get("route_path", ""), exc_info=error
        )
        return Problem(500, "internal", "The service failed; its log tells more. Nothing was changed.").response()
