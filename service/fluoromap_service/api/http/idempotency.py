"""``Idempotency-Key``: the same key and content gives the same answer for 24 hours; other content is an error.

The transaction that does the work also stores the answer, so both exist or neither does. Of two requests at the same time
the second waits for the transaction of the first, then repeats its answer.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from typing import Annotated

from fastapi import Depends, Header, Request
from fastapi.responses import Response
from sqlalchemy import delete, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from fluoromap_service.problem import Problem
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import writing
from fluoromap_service.store.models import Idempotency

STORED_SECONDS = 24 * 3600.0
_STORED_HEADERS = ("location", "retry-after")

Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=255,
        description="Repeating a request with the same key and content within 24 hours repeats its answer.",
        examples=["7a6c1a0e-upload-3"],
    ),
]


class Once:
    """The work of one request: done once, then repeated from the stored answer.

    Parameters
    ----------
    request : Request
    key : str or None
        The client's key; without a key the work is always done.
    content : str or None
        Hash of the request's content; None until an upload has arrived.
    """

    def __init__(self, request: Request, key: str | None, content: str | None = None) -> None:
        self._key = None if key is None else _hash(_caller(request), request.method, request.url.path, key)
        self._query = request.url.query
        self._study: str | None = request.path_params.get("study_id")
        self.content = content

    def answer(self, act: Callable[[Session], Response]) -> Response:
        """Run ``act`` and store its answer, or repeat the stored answer.

        ``act`` runs in a writing transaction. When ``act`` raises, nothing is stored and the key stays free.

        Raises
        ------
        Problem
            422 when an earlier request with this key had other content.
        """
        with writing() as session:
            if self._key is None:
                return act(session)
            if self.content is None:
                raise RuntimeError("a route that streams its body sets Once.content before it answers")
            content = _hash(self._query, self.content)
            session.execute(delete(Idempotency).where(Idempotency.created < db_now() - STORED_SECONDS))
            if not _reserve(session, self._key, content):
                row = session.scalars(select(Idempotency).where(Idempotency.key == self._key)).one()
                if row.request_sha256 != content:
                    raise Problem(
                        422,
                        "idempotency_key_reused",
                        "An earlier request had this Idempotency-Key and other content; use a new key.",
                        [("Idempotency-Key", "already used for another request")],
                    )
                headers = {**(row.headers or {}), "Idempotency-Replayed": "true"}
                return Response(row.body or "", row.status or 200, headers, "application/json")
            response = act(session)
            row = session.scalars(select(Idempotency).where(Idempotency.key == self._key)).one()
            row.status = response.status_code
            row.headers = {name: response.headers[name] for name in _STORED_HEADERS if name in response.headers}
            row.body = bytes(response.body).decode()
            # The answer can contain the study's label and notes: it is deleted together with the study.
            row.study_id = self._study or _created_study(response)
            return response


def _created_study(response: Response) -> str | None:
    collection, _, name = response.headers.get("location", "").rpartition("/")
    return name if collection == "/v1/studies" else None


def _reserve(session: Session, key: str, content: str) -> bool:
    """Add the key's row; return False when there is one.

    PostgreSQL waits here for another request with this key.
    """
    insert = postgresql.insert if session.get_bind().dialect.name == "postgresql" else sqlite.insert
    added = session.execute(
        insert(Idempotency)
        .values(key=key, request_sha256=content, created=db_now())
        .on_conflict_do_nothing(index_elements=["key"])
        .returning(Idempotency.id)
    )
    return added.first() is not None


def _caller(request: Request) -> str:
    caller = getattr(request.state, "caller", None)
    return caller.name if caller is not None else ""


def _hash(*parts: str) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


async def _json_once(request: Request, key: Key = None) -> Once:
    return Once(request, key, hashlib.sha256(await request.body()).hexdigest())


async def _upload_once(request: Request, key: Key = None) -> Once:
    return Once(request, key)


OnceJson = Annotated[Once, Depends(_json_once)]
"""For routes with a JSON body: ``once.answer(lambda session: JSONResponse(..., 201))``."""

OnceUpload = Annotated[Once, Depends(_upload_once)]
"""For routes that stream their body: set ``once.content`` to the parts' hashes before ``once.answer``."""
