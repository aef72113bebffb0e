"""CSV answers, for clients that prefer CSV to JSON."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

from fastapi import Request, Response

MEDIA_TYPE = "text/csv"
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")
"""Beginnings of a formula by OWASP's list, full-width signs too."""


def wants_csv(request: Request) -> bool:
    """Return whether the Accept header prefers text/csv to application/json (RFC 9110 section 12.5.1)."""
    quality = {"text/csv": 0.0, "application/json": 0.0}
    for entry in request.headers.get("accept", "").lower().split(","):
        media, *parameters = (part.strip() for part in entry.split(";"))
        if media in quality:
            quality[media] = next((_number(item[2:]) for item in parameters if item.startswith("q=")), 1.0)
    return quality["text/csv"] > 0 and quality["text/csv"] >= quality["application/json"]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return CSV with a header line.

    None becomes an empty field. Lines end in CRLF (RFC 4180).
    """
    stream = io.StringIO()
    writer = csv.writer(stream)
    writer.writerow(columns)
    writer.writerows([_plain_text(value) for value in row] for row in rows)
    return stream.getvalue()


def _plain_text(value: Any) -> Any:
    """Return a cell's value that a spreadsheet shows as text.

    The spreadsheet never runs it as a formula (OWASP, CSV injection).
    """
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA_STARTS) else value


def csv_response(text: str, file_name: str) -> Response:
    """Return CSV text as a download."""
    headers = {"Content-Disposition": f'attachment; filename="{file_name}"', "Vary": "Accept"}
    return Response(text, media_type="text/csv; charset=utf-8", headers=headers)


def csv_entry(description: str, example: str) -> dict[str, Any]:
    """Return the OpenAPI content of a CSV answer."""
    schema = {"type": "string", "description": description}
    return {MEDIA_TYPE: {"schema": schema, "example": example}}
