"""CSV tables of clients and spreadsheets; one wrong cell rejects the whole table."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from fastapi import Request
from numpy.typing import NDArray
from python_multipart.multipart import parse_options_header

from fluoromap_service.problem import Problem
from fluoromap_service.study.sites import ActivationTime, is_site_name

LARGEST_LAT_MS = 10_000.0
_MOST_ERRORS = 100
_LONGEST_NAME = 40
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d{1,3})?")

Errors = list[tuple[str, str]]
Rows = list[tuple[int, dict[str, str]]]


async def csv_text(request: Request) -> str:
    """Return the body of a request as text.

    Clients made by a generator call every file ``application/octet-stream``; such a body is read as a table too.

    Raises
    ------
    Problem
        415 for another content type, 400 when the text is not UTF-8.
    """
    kind, options = parse_options_header(request.headers.get("content-type"))
    charset = options.get(b"charset", b"utf-8").lower()
    if kind not in (b"text/csv", b"application/octet-stream") or charset not in (b"utf-8", b"utf8", b"us-ascii"):
        raise Problem(415, "unsupported_media_type", "Send the table as text/csv in UTF-8.")
    try:
        return (await request.body()).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise Problem(400, "not_utf8", "The table is not UTF-8; save it as 'CSV UTF-8'.") from None


def activation_times(text: str) -> list[ActivationTime]:
    """Return the rows of ``site,lat_ms`` and optionally ``view_a,view_b``.

    Raises
    ------
    Problem
        422 with the wrong rows and columns.
    """
    errors: Errors = []
    table: list[ActivationTime] = []
    first_rows: dict[str, int] = {}
    for row, cells in _rows(text, ("site", "lat_ms"), ("view_a", "view_b"), errors):
        site = cells["site"]
        if not is_site_name(site):
            errors.append((f"row {row}, column site", "not usable as a site's name (1 to 64 characters, no slash)"))
        elif site in first_rows:
            errors.append((f"row {row}, column site", f"row {first_rows[site]} has the same site"))
        first_rows.setdefault(site, row)
        lat_ms = _number(cells["lat_ms"], f"row {row}, column lat_ms", errors)
        if lat_ms is not None and abs(lat_ms) > LARGEST_LAT_MS:
            errors.append((f"row {row}, column lat_ms", f"must lie within {LARGEST_LAT_MS:.0f} ms"))
        view_a, view_b = cells.get("view_a") or None, cells.get("view_b") or None
        if view_a is not None and view_a == view_b:
            errors.append((f"row {row}, column view_b", "the two views must be two different runs"))
        table.append(ActivationTime(row, site, lat_ms or 0.0, view_a, view_b))
    _raise_if_wrong(errors)
    return table


def electrogram(text: str) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the columns ``time_ms,reference,mapping``, each (samples,).

    Raises
    ------
    Problem
        422 with the wrong rows and columns.
    """
    errors: Errors = []
    names = ("time_ms", "reference", "mapping")
    samples = [
        [_number(cells[name], f"row {row}, column {name}", errors) for name in names]
        for row, cells in _rows(text, names, (), errors)
    ]
    _raise_if_wrong(errors)
    columns = np.array(samples, dtype=np.float64).reshape(-1, 3).T
    return columns[0], columns[1], columns[2]


def _rows(text: str, required: Sequence[str], optional: Sequence[str], errors: Errors) -> Rows:
    first_line = text.lstrip("\r\n").split("\n", 1)[0]
    delimiter = next((mark for mark in (";", "\t") if mark in first_line), ",")
    try:
        records = list(csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True))
    except csv.Error:
        raise Problem(400, "malformed", "The table is not valid CSV; check its quotes.") from None
    numbered = [
        (row, [cell.strip() for cell in record])
        for row, record in enumerate(records, start=1)
        if any(cell.strip() for cell in record)
    ]
    names = numbered[0][1] if numbered else []
    header = [name.lower() for name in names]
    _check_header(names, numbered[0][0] if numbered else 1, required, optional)
    if len(numbered) == 1:
        errors.append((f"row {numbered[0][0]}", "no row follows the header; add the rows"))
    rows: Rows = []
    for row, cells in numbered[1:]:
        if len(cells) != len(header):
            hint = "; with decimal commas separate the columns by ';'" if delimiter == "," else ""
            errors.append((f"row {row}", f"has {len(cells)} cells instead of {len(header)}{hint}"))
        else:
            rows.append((row, dict(zip(header, cells, strict=True))))
    return rows


def _check_header(names: list[str], row: int, required: Sequence[str], optional: Sequence[str]) -> None:
    errors: Errors = []
    header = [name.lower() for name in names]
    for name in required:
        if name not in header:
            errors.append((f"row {row}", f"column {name} is missing"))
    for number, name in enumerate(header, start=1):
        if name not in (*required, *optional):
            known = ", ".join((*required, *optional))
            errors.append((f"row {row}, column {_shown(names[number - 1]) or number}", f"unknown column; use {known}"))
        elif name in header[: number - 1]:
            errors.append((f"row {row}", f"column {name} appears twice"))
    _raise_if_wrong(errors)


def _shown(name: str) -> str:
    """Return the beginning of a column's name for a message, without control characters."""
    return "".join(character for character in name[:_LONGEST_NAME] if character.isprintable())


def _number(text: str, where: str, errors: Errors) -> float | None:
    value = float(text.replace(",", ".")) if _NUMBER.fullmatch(text) else None
    if value is None or not np.isfinite(value):
        errors.append((where, "must be a number" if text else "is empty"))
        return None
    return value


def _raise_if_wrong(errors: Errors) -> None:
    if errors:
        mistakes = f"{len(errors)} mistake{'s' if len(errors) > 1 else ''}"
        detail = f"The table has {mistakes}, so the service stored nothing of it; correct it and send it again."
        raise Problem(422, "invalid_table", detail, errors[:_MOST_ERRORS])


def csv_body(example: str) -> dict[str, Any]:
    """Return the OpenAPI entry of a request body that is a table.

    Generators of clients know ``application/octet-stream``; few of them know ``text/csv``.
    """
    content = {
        "text/csv": {"schema": {"type": "string"}, "example": example},
        "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
    }
    return {"requestBody": {"required": True, "content": content}}
