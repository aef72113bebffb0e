"""The one way in which the service says no: a status, a stable code, and a sentence with the next step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class Problem(Exception):
    """A request that the service cannot carry out; the API sends it as an RFC 9457 problem document.

    Parameters
    ----------
    status : int
        HTTP status; it shows who has to act.
    code : str
        Stable code, snake_case.
    detail : str
        A sentence that says what is wrong and what to do, without patient data.
    errors : list of (where, message)
        The places in the request that are wrong.
    headers : mapping, optional
        Further headers of the answer.
    extra : dict
        Further facts for a program, for example the sites that lack something.
    """

    def __init__(
        self,
        status: int,
        code: str,
        detail: str,
        errors: list[tuple[str, str]] | None = None,
        *,
        headers: Mapping[str, str] | None = None,
        extra: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.errors = errors or []
        self.headers = dict(headers or {})
        self.extra = extra or {}

    def __reduce__(self) -> tuple[Any, ...]:
        # By default an exception is rebuilt from its message alone, and a Problem also travels between processes.
        return _rebuilt, (self.status, self.code, self.detail, self.errors, self.headers, self.extra)


def _rebuilt(
    status: int, code: str, detail: str, errors: list[tuple[str, str]], headers: dict[str, str], extra: dict[str, Any]
) -> Problem:
    return Problem(status, code, detail, errors, headers=headers, extra=extra)


def not_found(what: str) -> Problem:
    """Return the 404 for a resource that does not exist."""
    return Problem(404, "not_found", f"There is no such {what}.")
