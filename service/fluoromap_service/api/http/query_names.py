"""Query parameters that a route does not know: an error, so that nobody trusts a misspelt one."""

from __future__ import annotations

from collections.abc import Iterator

from fastapi import Request
from fastapi.dependencies.models import Dependant

from fluoromap_service.problem import Problem


async def check_query_names(request: Request) -> None:
    """Check that the route has every query parameter of the request.

    The application gives this dependency to all of its routes but the searches of DICOMweb. Their parameters are DICOM attributes
    (PS3.18 section 8.3.4), and they check the names themselves.

    Raises
    ------
    Problem
        422 ``unknown_parameter`` with each unknown name.
    """
    if not request.scope["query_string"]:
        return
    known = sorted(set(_names(request.scope["route"].dependant)))
    unknown = [name for name in dict.fromkeys(request.query_params) if name not in known]
    if unknown:
        hint = f"use {', '.join(known)}" if known else "this address has no parameters"
        detail = "The address has unknown query parameters; see 'errors' for the known ones."
        raise Problem(422, "unknown_parameter", detail, [(f"query.{name}", f"unknown; {hint}") for name in unknown])


def _names(dependant: Dependant) -> Iterator[str]:
    yield from (field.alias for field in dependant.query_params)
    for below in dependant.dependencies:
        yield from _names(below)
