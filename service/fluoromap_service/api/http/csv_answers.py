"""CSV answers, for clients that prefer CSV to JSON."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from fastapi import Request, Response

MEDIA_TYPE = "text/csv"
MEDIA_TYPE_UTF8 = "text/csv; charset=utf-8"
PIECE_CHARACTERS = 1 << 18
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
    return b"".join(csv_pieces(columns, rows)).decode()


def csv_pieces(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> Iterator[bytes]:
    """Return the text of :func:`csv_text` as UTF-8, piece by piece."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream)
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_plain_text(value) if isinstance(value, str) else value for value in row])
        if stream.tell() >= PIECE_CHARACTERS:
            yield stream.getvalue().encode()
            stream.seek(0)
            stream.truncate()
    yield stream.getvalue().encode()


def _plain_text(value: str) -> str:
    """Return a cell's value that a spreadsheet shows as text.

    The spreadsheet never runs it as a formula (OWASP, CSV injection).
    """
    return f"'{value}" if value.startswith(_FORMULA_STARTS) else value


def csv_response(text: str, file_name: str) -> Response:
    """Return CSV text as a download."""
    return Response(text, media_type=MEDIA_TYPE_UTF8, headers=csv_headers(file_name))


def csv_headers(file_name: str) -> dict[str, str]:
    """Return the headers of a CSV download."""
    return {"Content-Disposition": f'attachment; filename="{file_name}"', "Vary": "Accept"}


def csv_entry(description: str, example: str) -> dict[str, Any]:
    """Return the OpenAPI content of a CSV answer."""
    schema = {"type": "string", "description": description}
    return {MEDIA_TYPE: {"schema": schema, "example": example}}
