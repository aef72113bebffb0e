"""Routers of the service: all routes check names of parameters and conditions, and a request takes one thread."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from enum import Enum
from typing import Any

from fastapi import APIRouter, Depends, Response
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool

from fluoromap_service.api.http.preconditions import refuse_unknown_condition
from fluoromap_service.api.http.query_names import check_query_names


class OneThreadRoute(APIRoute):
    """A route whose ordinary function runs in a thread, and nothing else of the request.

    FastAPI would check the answer of such a function in a second thread, and wait for it. Coroutines and streams stay as they are.
    """

    def __init__(self, path: str, endpoint: Callable[..., Any], **options: Any) -> None:
        super().__init__(path, _in_thread(endpoint), **options)


_NOT_ORDINARY = (inspect.iscoroutinefunction, inspect.isasyncgenfunction, inspect.isgeneratorfunction)


def _in_thread(function: Callable[..., Any]) -> Callable[..., Any]:
    if any(kind(function) for kind in _NOT_ORDINARY):
        return function

    @functools.wraps(function)
    async def run(**values: Any) -> Any:
        return await run_in_threadpool(function, **values)

    return run


def new_router(
    prefix: str = "",
    *,
    tags: list[str | Enum] | None = None,
    include_in_schema: bool = True,
    any_query_name: bool = False,
    describe: Callable[..., None] | None = None,
    responses: dict[int | str, dict[str, Any]] | None = None,
) -> APIRouter:
    """Return an empty router whose routes the application takes over as they are.

    Parameters
    ----------
    prefix : str
    tags : list of str, optional
    include_in_schema : bool
    any_query_name : bool
        For routes that check the names of their query parameters themselves.
    describe : callable, optional
        Its arguments are further query parameters of all routes.
    responses : dict, optional
        Answers of all routes for the OpenAPI document. Their own media types are these alone.
    """
    first: list[Callable[..., Any]] = [refuse_unknown_condition]
    if not any_query_name:
        first.insert(0, check_query_names)
    if describe is not None:
        first.append(describe)
    return APIRouter(
        prefix=prefix,
        tags=tags,
        include_in_schema=include_in_schema,
        dependencies=[Depends(each) for each in first],
        generate_unique_id_function=_operation_id,
        route_class=OneThreadRoute,
        responses=responses,
        default_response_class=JSONResponse if responses is None else Response,
    )


def _operation_id(route: APIRoute) -> str:
    """Return the name of a route's function.

    Generators of clients name their calls after it.
    """
    return route.name
