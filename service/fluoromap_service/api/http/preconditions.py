"""``If-Match``: a change is carried out only on the version that the client has read (RFC 9110 section 13.1.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Header, Request

from fluoromap_service.problem import Problem

_READING = frozenset({"GET", "HEAD", "OPTIONS"})

Tags = Annotated[
    str | None,
    Header(
        alias="If-Match",
        description="The `ETag` that the client has read; another one is now 412.",
        examples=['"3"'],
    ),
]


@dataclass(frozen=True, slots=True)
class Precondition:
    """The entity tags on which a request depends; None: on no tag."""

    tags: frozenset[str] | None

    def check(self, etag: str) -> None:
        """Check that the current version is one that the client named.

        Call it inside the transaction that makes the change, under the lock of the study: of two writers with the same
        tag the second then sees the change of the first. The comparison is strong (RFC 9110 section 8.8.3.2).

        Raises
        ------
        Problem
            412 ``precondition_failed``.
        """
        if self.tags is not None and etag not in self.tags:
            detail = (
                "Somebody has changed this since you read it; read it again, and send your change with its new ETag."
            )
            raise Problem(412, "precondition_failed", detail, [("If-Match", "is not the current ETag")])


async def _precondition(if_match: Tags = None) -> Precondition:
    tags = None if if_match is None else frozenset(tag.strip() for tag in if_match.split(","))
    return Precondition(None if tags is None or "*" in tags else tags)


IfMatch = Annotated[Precondition, Depends(_precondition)]
"""For routes that change something with an entity tag."""


async def refuse_unknown_condition(request: Request) -> None:
    """Refuse a change that depends on the entity tag of a thing that has none.

    The application gives this dependency to all of its routes: a route that knows no condition must not act as if the condition
    were true.

    Raises
    ------
    Problem
        412 ``precondition_failed``.
    """
    if request.method in _READING or request.headers.get("if-match", "*").strip() == "*":
        return
    if not any(below.call is _precondition for below in request.scope["route"].dependant.dependencies):
        detail = "This address has no ETag to compare with; send the request without If-Match."
        raise Problem(412, "precondition_failed", detail, [("If-Match", "not known here")])
