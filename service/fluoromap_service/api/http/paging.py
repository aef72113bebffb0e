"""Lists in pages: ``?limit=&cursor=``, ``next`` in the answer and ``Link: rel="next"``."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Generic, TypeVar

from fastapi import Depends, Query, Request, Response
from pydantic import BaseModel, Field
from sqlalchemy import ColumnElement, bindparam, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from fluoromap_service.problem import Problem
from fluoromap_service.store.models import Delivery, Job, Study

Item = TypeVar("Item")
Model = TypeVar("Model")


class Page(BaseModel, Generic[Item]):
    """One page of a list."""

    items: list[Item]
    next: str | None = Field(description="Cursor of the next page; null on the last one.", examples=[None])


class NewestFirst:
    """The query of a list, the newest rows first.

    A module builds it once: SQLAlchemy would build it anew for each request.

    Parameters
    ----------
    kind : type
        Table of the list.
    *columns
        Columns that the list shows, among them ``id`` and ``created``; by default whole rows.
    """

    def __init__(self, kind: type[Study | Job | Delivery], *columns: InstrumentedAttribute[Any]) -> None:
        self.whole_rows = not columns
        self.sort_key = tuple_(kind.created, kind.id)
        query = select(*columns) if columns else select(kind)
        self.query = query.order_by(kind.created.desc(), kind.id.desc()).limit(bindparam("rows"))


class Paging:
    """The page that a client asks for.

    A cursor is the sort key of the last item on the page before. The store is asked for one item more than ``limit``: it
    shows that another page follows.
    """

    def __init__(self, request: Request, response: Response, limit: int, cursor: str | None) -> None:
        self._request = request
        self._response = response
        self.limit = limit
        self._after: Any = None if cursor is None else _decode(cursor)

    def newest_first(self, session: Session, newest: NewestFirst, *conditions: ColumnElement[bool]) -> Sequence[Any]:
        """Return the rows of the page and one more, the newest first.

        Raises
        ------
        Problem
            400 when the cursor belongs to another list.
        """
        query, after = newest.query, self._key(float, str)
        if conditions:
            query = query.where(*conditions)
        if after is not None:
            query = query.where(newest.sort_key < after)
        rows = session.execute(query, {"rows": self.limit + 1})
        return rows.scalars().all() if newest.whole_rows else rows.all()

    def page_of_newest(self, rows: Sequence[Any], shape: Callable[[Any], Item]) -> Page[Item]:
        """Return the page of the rows that :meth:`newest_first` found."""
        return self._page(rows, shape, lambda row: [row.created, row.id])

    def page_of_all(
        self, items: Sequence[Model], shape: Callable[[Model], Item], name: Callable[[Model], str]
    ) -> Page[Item]:
        """Return a page of a short list; ``name`` gives the unique name of an item.

        Raises
        ------
        Problem
            400 when the cursor belongs to another list.
        """
        key = self._key(str)
        names = [name(item) for item in items]
        if key is not None and key[0] not in names:
            raise _bad_cursor()
        start = 0 if key is None else names.index(key[0]) + 1
        return self._page(items[start:], shape, lambda item: [name(item)])

    def _key(self, *kinds: type) -> tuple[Any, ...] | None:
        if self._after is None:
            return None
        if not isinstance(self._after, list) or [type(part) for part in self._after] != list(kinds):
            raise _bad_cursor()
        return tuple(self._after)

    def _page(
        self, items: Sequence[Model], shape: Callable[[Model], Item], sort_key: Callable[[Model], list[Any]]
    ) -> Page[Item]:
        shown = items[: self.limit]
        following = _encode(sort_key(shown[-1])) if len(items) > self.limit else None
        if following is not None:
            link = self._request.url.include_query_params(limit=self.limit, cursor=following)
            self._response.headers["Link"] = f'<{link}>; rel="next"'
        return Page(items=[shape(item) for item in shown], next=following)


async def _paging(
    request: Request,
    response: Response,
    limit: Annotated[int, Query(ge=1, le=500, description="Most items on a page.")] = 50,
    cursor: Annotated[str | None, Query(max_length=500, description="`next` of the page before.")] = None,
) -> Paging:
    # Not the class itself: FastAPI would run it in a thread.
    return Paging(request, response, limit, cursor)


Pages = Annotated[Paging, Depends(_paging)]


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
