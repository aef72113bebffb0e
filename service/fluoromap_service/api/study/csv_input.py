"""CSV tables of clients and spreadsheets; one wrong cell rejects the whole table."""

from __future__ import annotations

import codecs
import csv
import io
import re
import unicodedata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from fastapi import Request
from numpy.typing import NDArray
from python_multipart.multipart import parse_options_header

from fluoromap_service.problem import Problem
from fluoromap_service.store.names import normal_name
from fluoromap_service.study.sites import ActivationTime, is_site_name

LARGEST_LAT_MS = 10_000.0
_MOST_ERRORS = 100
_LONGEST_NAME = 40
_NUMBER = re.compile(r"[+-]?([0-9]+([.,][0-9]*)?|[.,][0-9]+)([eE][+-]?[0-9]{1,3})?")
_MINUS = "\N{MINUS SIGN}"
_DOS_END = "\x1a"
_SEPARATORS = {";": "';'", "\t": "a tab", ",": "','"}

Errors = list[tuple[str, str]]
Rows = list[tuple[int, dict[str, str]]]


@dataclass(frozen=True, slots=True)
class _Table:
    """The rows of a table below its header, each with its number and its cells by column."""

    rows: Rows
    separator: str


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
    body = await request.body()
    # Every second byte of plain text in UTF-16 is 0, and 0 is also valid UTF-8.
    if body.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in body:
        raise Problem(400, "not_utf8", "The table is UTF-16 or no text; save it as 'CSV UTF-8'.")
    try:
        return body.decode("utf-8-sig")
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
    read = _read(text, ("site", "lat_ms"), ("view_a", "view_b"), errors)
    wrong_times: Errors = []
    times_ms = _numbers(read, ("lat_ms",), wrong_times)
    for (row, cells), (lat_ms,) in zip(read.rows, times_ms, strict=True):
        site = normal_name(cells["site"])
        if not is_site_name(site):
            errors.append((f"row {row}, column site", "not usable as a site's name (1 to 64 characters, no slash)"))
        elif site in first_rows:
            errors.append((f"row {row}, column site", f"row {first_rows[site]} has the same site"))
        first_rows.setdefault(site, row)
        if lat_ms is not None and abs(lat_ms) > LARGEST_LAT_MS:
            errors.append((f"row {row}, column lat_ms", f"must lie within {LARGEST_LAT_MS:.0f} ms"))
        view_a, view_b = (normal_name(cells.get(view, "")) or None for view in ("view_a", "view_b"))
        if view_a is not None and view_a == view_b:
            errors.append((f"row {row}, column view_b", "the two views must be two different runs"))
        table.append(ActivationTime(row, site, lat_ms or 0.0, view_a, view_b))
    _raise_if_wrong(sorted([*errors, *wrong_times], key=_row_of))
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
    samples = _numbers(_read(text, names, (), errors), names, errors)
    _raise_if_wrong(errors)
    columns = np.array(samples, dtype=np.float64).reshape(-1, 3).T
    return columns[0], columns[1], columns[2]


def _read(text: str, required: Sequence[str], optional: Sequence[str], errors: Errors) -> _Table:
    numbered, separator = _records(text, errors)
    names = numbered[0][1] if numbered else []
    width = len(names)
    while names and not names[-1]:
        # Spreadsheets write columns that were once used; below they must be empty too.
        names = names[:-1]
    if any(any(cells[len(names) : width]) for _, cells in numbered[1:]):
        names = numbered[0][1]
    header = [name.lower() for name in names]
    _check_header(names, numbered[0][0] if numbered else 1, required, optional)
    if len(numbered) == 1:
        errors.append((f"row {numbered[0][0]}", "no row follows the header; add the rows"))
    rows: Rows = []
    for row, cells in numbered[1:]:
        if len(cells) not in (len(header), width):
            hint = "; with decimal commas separate the columns by ';'" if separator == "," else ""
            errors.append((f"row {row}", f"has {len(cells)} cells instead of {len(header)}{hint}"))
        else:
            rows.append((row, dict(zip(header, cells, strict=False))))
    return _Table(rows, separator)


def _records(text: str, errors: Errors) -> tuple[list[tuple[int, list[str]]], str]:
    """Return the records that are not blank with their numbers, and the separator.

    A first line ``sep=;`` of Excel names the separator. Lines before the header that begin with # are comments.
    """
    text = text.rstrip()
    lines = io.StringIO(text.removesuffix(_DOS_END), newline="").readlines()
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    told = re.fullmatch(r'"?sep=(.+?)"?', first.strip("\r\n"), re.IGNORECASE)
    if told is not None and told[1] not in _SEPARATORS:
        known = ", ".join(_SEPARATORS.values())
        raise Problem(
            422,
            "invalid_table",
            f"The line 'sep=' names a separator that the service does not read; use one of {known}.",
            [(f"row {lines.index(first) + 1}", "unknown separator")],
        )
    separator = told[1] if told is not None else next((mark for mark in _SEPARATORS if mark in first), ",")
    numbered: list[tuple[int, list[str]]] = []
    is_told = told is not None
    for row, line, cells in _parsed(lines, separator):
        if line.startswith("#"):
            if numbered:
                # It may be a comment, a row that somebody struck out, or a name.
                errors.append(
                    (f"row {row}", "begins with '#'; remove the line, or put a name that begins so in quotes")
                )
        elif is_told and line == first:
            is_told = False
        elif any(cells):
            numbered.append((row, cells))
    return numbered, separator


def _parsed(lines: Sequence[str], separator: str) -> Iterator[tuple[int, str, list[str]]]:
    """Yield the number of each record, its first line, and its cells."""
    reader = csv.reader(lines, delimiter=separator, strict=True)
    begin = 0
    try:
        for row, record in enumerate(reader, start=1):
            yield row, lines[begin], [cell.strip() for cell in record]
            begin = reader.line_num
    except csv.Error:
        raise Problem(400, "malformed", "The table is not valid CSV; check its quotes.") from None


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


def _numbers(table: _Table, columns: Sequence[str], errors: Errors) -> list[list[float | None]]:
    """Return the numbers of some columns, row by row.

    None for a cell that is no number. One table has one decimal sign. It is the point where a comma separates the columns.
    """
    cells = [[cells[name].replace(_MINUS, "-") for name in columns] for _, cells in table.rows]
    decimal: tuple[str, str] | None = None
    numbers: list[list[float | None]] = []
    for (row, _), texts in zip(table.rows, cells, strict=True):
        values: list[float | None] = []
        for name, text in zip(columns, texts, strict=True):
            where = f"row {row}, column {name}"
            value = float(text.replace(",", ".")) if _NUMBER.fullmatch(text) else None
            sign = next((sign for sign in ",." if sign in text), None)
            if value is None or not np.isfinite(value):
                errors.append((where, _why_no_number(text)))
                value = None
            elif sign == "," and table.separator == ",":
                errors.append((where, "has a comma; where commas separate the columns the decimal sign is a point"))
            elif sign is not None and decimal is not None and sign != decimal[0]:
                errors.append(
                    (where, f"has {sign!r} as decimal sign, and {decimal[1]} has {decimal[0]!r}; use one of them")
                )
            elif sign is not None and decimal is None:
                decimal = sign, where
            values.append(value)
        numbers.append(values)
    return numbers


def _why_no_number(text: str) -> str:
    if not text:
        return "is empty"
    strange = next((character for character in text if not character.isascii()), None)
    if strange is not None:
        name = unicodedata.name(strange, "a character without a name").lower()
        return f"has the character {name} (U+{ord(strange):04X}); write the number in the digits 0 to 9"
    return "must be a number, without unit and without a separator of thousands"


def _row_of(error: tuple[str, str]) -> int:
    return int(error[0].split(",")[0].removeprefix("row "))


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
