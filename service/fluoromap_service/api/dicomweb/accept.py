"""The media types that a request accepts (RFC 9110 section 12.5.1, PS3.18 section 8.7)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from fastapi import Request

from fluoromap_service.problem import Problem

DICOM_JSON = "application/dicom+json"
_JSON_TYPES = (DICOM_JSON, "application/json")
_RELATED = "multipart/related"
_KIND = re.compile(r"(\*/\*|[a-z0-9!#$&^_.+-]+/(?:\*|[a-z0-9!#$&^_.+-]+))")
_QUALITY = re.compile(r"0(\.[0-9]{0,3})?|1(\.0{0,3})?")


class Form(Enum):
    """How an answer holds its parts."""

    SINGLE = "single"
    """One part, with its own content type."""
    RELATED = "related"
    """``multipart/related``, with the content type of the parts as its parameter."""


@dataclass(frozen=True, slots=True)
class MediaRange:
    """One item of an Accept header, in lower case: ``multipart/related; type="application/dicom"; q=0.8``."""

    kind: str
    parameters: dict[str, str]
    quality: float = 1.0

    def allows(self, kind: str) -> bool:
        """Return whether the range holds a media type."""
        return self.kind in ("*/*", f"{kind.split('/')[0]}/*", kind)

    @property
    def precision(self) -> int:
        """How much the range says; a range that says more counts before one that says less."""
        return 0 if self.kind == "*/*" else 1 if self.kind.endswith("/*") else 2 + bool(self.parameters)


def media_ranges(text: str) -> list[MediaRange]:
    """Return the items of an Accept header, the preferred one first.

    Damaged items are left out. An empty header accepts everything. Items with quality 0 come last: they refuse a type.
    """
    if not text.strip():
        return [MediaRange("*/*", {})]
    found = [item for part in _split(text.lower(), ",") if (item := _media_range(part)) is not None]
    return sorted(found, key=lambda item: (-item.quality, -item.precision))


def _media_range(text: str) -> MediaRange | None:
    kind, *rest = (part.strip() for part in _split(text, ";"))
    if not _KIND.fullmatch(kind):
        return None
    parameters = {}
    for parameter in rest:
        name, _, value = parameter.partition("=")
        parameters[name.strip()] = value.strip().strip('"').strip()
    quality = parameters.pop("q", "1")
    return MediaRange(kind, parameters, float(quality)) if _QUALITY.fullmatch(quality) else None


def _split(text: str, separator: str) -> list[str]:
    """Split a text at a separator outside quoted strings."""
    pieces, start, quoted, escaped = [], 0, False, False
    for place, letter in enumerate(text):
        if escaped:
            escaped = False
        elif letter == "\\" and quoted:
            escaped = True
        elif letter == '"':
            quoted = not quoted
        elif letter == separator and not quoted:
            pieces.append(text[start:place])
            start = place + 1
    return [*pieces, text[start:]]


def _accepted(request: Request) -> list[MediaRange]:
    """Return the ranges of all Accept headers of a request."""
    return media_ranges(",".join(request.headers.getlist("accept")))


def json_type(request: Request) -> str:
    """Return the media type for an answer in JSON.

    Raises
    ------
    Problem
        406 ``not_acceptable``, also for a request that accepts XML only.
    """
    ranges = _accepted(request)
    for item in ranges:
        for kind in _JSON_TYPES:
            if item.quality > 0 and item.allows(kind) and not _refused(ranges, item, kind):
                return kind
    raise not_acceptable(f"This address answers with {DICOM_JSON}; change the Accept header.")


def _refused(ranges: Sequence[MediaRange], by: MediaRange, kind: str) -> bool:
    """Return whether a range with quality 0 refuses a type that the range ``by`` allows."""
    return any(item.quality == 0 and item.allows(kind) and item.precision > by.precision for item in ranges)


def answer_form(request: Request, kind: str, syntaxes: Sequence[str]) -> Form:
    """Return the form of an answer that holds one or several parts.

    Parameters
    ----------
    request : Request
    kind : str
        Media type of each part: ``application/dicom``.
    syntaxes : sequence of str
        Transfer syntax of each part. A range that names transfer syntaxes accepts these only; ``*`` accepts any.

    Raises
    ------
    Problem
        406 ``not_acceptable``. A single part is refused where there are several.
    """
    ranges = _accepted(request)
    allowed = [(item, form) for item in ranges if item.quality > 0 for form in _forms(ranges, item, kind)]
    if not allowed:
        raise not_acceptable(f'This address answers with {_RELATED}; type="{kind}", or one part alone as {kind}.')
    right = [(item, form) for item, form in allowed if form is Form.RELATED or len(syntaxes) == 1]
    if not right:
        raise not_acceptable(f'The answer has {len(syntaxes)} parts; accept {_RELATED}; type="{kind}".')
    asked = {form: {item.parameters.get("transfer-syntax", "*") for item, of in right if of is form} for form in Form}
    for _, form in right:
        if "*" in asked[form] or asked[form].issuperset(syntaxes):
            return form
    raise not_acceptable("The parts have another transfer syntax; ask for transfer-syntax=*.")


def _forms(ranges: Sequence[MediaRange], item: MediaRange, kind: str) -> list[Form]:
    """Return the forms that a range allows, the preferred one first."""
    forms = []
    if item.allows(_RELATED) and _is_type(item, kind) and not _refused(ranges, item, _RELATED):
        forms.append(Form.RELATED)
    if item.allows(kind) and not _refused(ranges, item, kind):
        forms.append(Form.SINGLE)
    return forms


def _is_type(item: MediaRange, kind: str) -> bool:
    """Return whether the parameter ``type`` of a multipart range allows parts of a media type."""
    return MediaRange(item.parameters.get("type", "*/*"), {}).allows(kind)


def not_acceptable(detail: str) -> Problem:
    """Return the problem of a request whose Accept header allows no answer."""
    return Problem(406, "not_acceptable", detail)
