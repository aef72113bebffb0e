"""Lists a page at a time: ``?limit=&cursor=``, ``next`` in the answer and ``Link: rel="next"``."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Generic, TypeVar

from fastapi import Depends, Query, Request, Response
from pydantic import BaseModel, Field

from fluoromap_service.problem import Problem

Item = TypeVar("Item")
Model = TypeVar("Model")


class Page(BaseModel, Generic[Item]):
    """One page of a list."""

    items: list[Item]
    next: str | None = Field(description="Cursor of the next page; null on the last one.", examples=[None])


class Paging:
    """What a client asked for, and how to answer it.

    ``after`` is the sort key of the last item already seen (None: from the start); ask the store for ``limit + 1`` items.
    """

    def __init__(
        self,
        request: Request,
        response: Response,
        limit: Annotated[int, Query(ge=1, le=500, description="Most items on a page.")] = 50,
        cursor: Annotated[
            str | None, Query(max_length=500, description="`next` of the page before; it means nothing to a client.")
        ] = None,
    ) -> None:
        self._request = request
        self._response = response
        self.limit = limit
        self.after: Any = None if cursor is None else _decode(cursor)

    def key(self, *kinds: type) -> tuple[Any, ...] | None:
        """``after`` as a sort key of those types; None from the start.

        Raises
        ------
        Problem
            400 when the cursor was not made for this list.
        """
        if self.after is None:
            return None
        if not isinstance(self.after, list) or [type(part) for part in self.after] != list(kinds):
            raise _bad_cursor()
        return tuple(self.after)

    def page(
        self, found: Sequence[Model], shape: Callable[[Model], Item], sort_key: Callable[[Model], Sequence[Any]]
    ) -> Page[Item]:
        """The page of the first ``limit`` of ``found``; one more than ``limit`` says that another page follows."""
        shown = found[: self.limit]
        following = _encode(list(sort_key(shown[-1]))) if len(found) > self.limit else None
        if following is not None:
            link = self._request.url.include_query_params(limit=self.limit, cursor=following)
            self._response.headers["Link"] = f'<{link}>; rel="next"'
        return Page(items=[shape(item) for item in shown], next=following)

    def slice(
        self, everything: Sequence[Model], shape: Callable[[Model], Item], sort_key: Callable[[Model], str]
    ) -> Page[Item]:
        """A page of a short list that is at hand in full, named by a unique text of each item."""
        key = self.key(str)
        names = [sort_key(item) for item in everything]
        if key is not None and key[0] not in names:
            raise _bad_cursor()
        start = 0 if key is None else names.index(key[0]) + 1
        return self.page(everything[start:], shape, lambda item: [sort_key(item)])


Pages = Annotated[Paging, Depends()]


def _encode(key: list[Any]) -> str:
    return base64.urlsafe_b64encode(json.dumps(key, separators=(",", ":")).encode()).decode().rstrip("=")


def _decode(cursor: str) -> Any:
    try:
        key = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
    except (ValueError, binascii.Error):
        raise _bad_cursor() from None
    if key is None:
        raise _bad_cursor()
    return key


def _bad_cursor() -> Problem:
    return Problem(
        400, "bad_cursor", "This cursor does not belong to this list; start again without one.", [("cursor", "unknown")]
    )
