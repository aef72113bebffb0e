"""The media types that a request accepts (RFC 9110 section 12.5.1, PS3.18 section 8.7)."""

from __future__ import annotations

import re

from fastapi import Request

from fluoromap_service.problem import Problem


def accepted_types(request: Request, *kinds: str) -> list[str]:
    """Check the parameters and the Accept header, and return its fitting items.

    A request has no parameters and accepts one of the media types.

    Raises
    ------
    Problem
        406 ``not_acceptable`` or 422 ``unknown_parameter``.
    """
    accepted = [item for item in request.headers.get("accept", "*/*").lower().split(",") if _fits(item, kinds)]
    if not accepted:
        raise not_acceptable(f"This address answers with {kinds[-1]}; change the Accept header.")
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


def asked_syntaxes(accepted: list[str]) -> set[str]:
    """Return the transfer syntaxes of an Accept header.

    ``*`` means any. The set is empty when an item names none.
    """
    asked = [re.findall(r'transfer-syntax="?([0-9.*]+)', item) for item in accepted]
    return set() if [] in asked else {syntax for found in asked for syntax in found}


def not_acceptable(detail: str) -> Problem:
    """Return the problem of a request whose Accept header allows no answer."""
    return Problem(406, "not_acceptable", detail)
