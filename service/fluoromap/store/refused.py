"""Requests that the store understands and has to refuse."""

from __future__ import annotations

from typing import Any


class Refused(Exception):
    """A request that cannot be carried out as it stands; the REST doors turn it into a problem document.

    Parameters
    ----------
    status : int
        HTTP status that says who has to act: 404, 409 or 422.
    code : str
        Stable code, snake_case.
    detail : str
        A sentence that tells the user what to do; no patient data.
    errors : list of (where, message)
        The places that are wrong.
    extra : dict
        Further facts for a program, for example the sites that miss something.
    """

    def __init__(
        self,
        status: int,
        code: str,
        detail: str,
        errors: list[tuple[str, str]] | None = None,
        extra: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.errors = errors or []
        self.extra = extra or {}
