"""``Idempotency-Key``: the same key and content gives the same answer for 24 hours, other content is refused.

The answer is stored in the transaction that does the work: either both exist or neither, and of two requests at the same
time the second waits for the first one's transaction and repeats its answer.
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

KEPT_SECONDS = 24 * 3600.0
_KEPT_HEADERS = ("location", "retry-after")

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
    """Does the work of one request, or repeats the answer that its key was given before.

    Parameters
    ----------
    request : Request
    key : str or None
        The client's key; without one the work is simply done.
    content : str or None
        Hash of the request's content; None until an upload has arrived.
    """

    def __init__(self, request: Request, key: str | None, content: str | None = None) -> None:
        self._key = None if key is None else _hash(_caller(request), request.method, request.url.path, key)
        self._query = request.url.query
        self.content = content

    def answer(self, act: Callable[[Session], Response]) -> Response:
        """Run ``act`` in a writing transaction and keep its answer, or repeat the one kept.

        ``act`` may raise: then nothing is stored and the key stays free.

        Raises
        ------
        Problem
            422 when the key came with other content before.
        """
        with writing() as session:
            if self._key is None:
                return act(session)
            if self.content is None:
                raise RuntimeError("a route that streams its body sets Once.content before it answers")
            content = _hash(self._query, self.content)
            session.execute(delete(Idempotency).where(Idempotency.created < db_now() - KEPT_SECONDS))
            if not _reserve(session, self._key, content):
                row = session.scalars(select(Idempotency).where(Idempotency.key == self._key)).one()
                if row.request_sha256 != content:
                    raise Problem(
                        422,
                        "idempotency_key_reused",
                        "This Idempotency-Key was sent with other content before; use a new key.",
                        [("Idempotency-Key", "already used for another request")],
                    )
                headers = {**(row.headers or {}), "Idempotency-Replayed": "true"}
                return Response(row.body or "", row.status or 200, headers, "application/json")
            response = act(session)
            row = session.scalars(select(Idempotency).where(Idempotency.key == self._key)).one()
            row.status = response.status_code
            row.headers = {name: response.headers[name] for name in _KEPT_HEADERS if name in response.headers}
            row.body = bytes(response.body).decode()
            return response


def _reserve(session: Session, key: str, content: str) -> bool:
    """Add the key's row; False when it is there. PostgreSQL waits here for another request with the same key."""
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
