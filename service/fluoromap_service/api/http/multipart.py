"""Multipart bodies, parsed while they arrive."""

from __future__ import annotations

from abc import ABC, abstractmethod

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser

from fluoromap_service.problem import Problem

MOST_PARTS = 2000


class MultipartBody(ABC):
    """A body of several parts. A subclass says what becomes of a part.

    Parameters
    ----------
    boundary : bytes
        From the request's content type.
    """

    def __init__(self, boundary: bytes) -> None:
        self.ended = False
        self._parts = 0
        self._headers: dict[bytes, bytes] = {}
        self._header = (b"", b"")
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._on_part_begin,
                "on_header_field": self._on_header_field,
                "on_header_value": self._on_header_value,
                "on_header_end": self._on_header_end,
                "on_headers_finished": self._on_headers_finished,
                "on_part_data": self._on_part_data,
                "on_part_end": self.end_part,
                "on_end": self._on_end,
            },
        )

    @abstractmethod
    def begin_part(self, headers: dict[bytes, bytes]) -> None:
        """Begin a part; the names of its headers are in lower case."""

    @abstractmethod
    def add(self, data: bytes) -> None:
        """Take the next bytes of the part."""

    @abstractmethod
    def end_part(self) -> None:
        """End the part."""

    def write(self, data: bytes) -> None:
        """Parse the next bytes of the body.

        Raises
        ------
        Problem
            400 for a malformed body, 413 for too many parts.
        """
        try:
            self._parser.write(data)
        except FormParserError:
            raise malformed() from None

    def _on_part_begin(self) -> None:
        self._parts += 1
        if self._parts > MOST_PARTS:
            raise Problem(
                413, "too_many_parts", f"A request may have {MOST_PARTS} parts; send the rest in another request."
            )
        self._headers, self._header = {}, (b"", b"")

    def _on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._header = (self._header[0] + data[start:end], self._header[1])

    def _on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._header = (self._header[0], self._header[1] + data[start:end])

    def _on_header_end(self) -> None:
        name, value = self._header
        self._headers[name.lower()] = value
        self._header = (b"", b"")

    def _on_headers_finished(self) -> None:
        self.begin_part(self._headers)

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        self.add(data[start:end])

    def _on_end(self) -> None:
        self.ended = True


def malformed() -> Problem:
    """Return the problem of a broken multipart body."""
    return Problem(400, "malformed", "The multipart body is malformed or ends too early; send the request again.")
