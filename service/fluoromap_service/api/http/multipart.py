"""Multipart bodies (RFC 2046 section 5.1.1), parsed while they arrive."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod

from fluoromap_service.problem import Problem

MOST_PARTS = 2000
LONGEST_HEADERS = 16 * 1024
"""Bytes of the headers of a part."""
LONGEST_PADDING = 1024
"""Bytes of blanks behind a boundary; a longer line is content."""
_PIECE_BYTES = 1 << 16
"""Bytes that are searched at once: their copies take memory that is warm already, which is several times as fast."""
_BLANK_LINE = re.compile(rb"(?:\A|\n)\r?\n")
_FOLD = re.compile(rb"\r?\n[ \t]+")


class MultipartBody(ABC):
    """A body of several parts. A subclass says what becomes of a part.

    Text before the first boundary and after the last one is ignored, as blanks behind a boundary are. Lines end with CR LF, or
    with LF alone.

    Parameters
    ----------
    boundary : bytes or None
        From the request's content type.

    Raises
    ------
    Problem
        400 ``malformed`` without a boundary.
    """

    def __init__(self, boundary: bytes | None) -> None:
        if not boundary:
            raise malformed("The content type names no boundary; add the parameter boundary.")
        self._delimiter = b"\n--" + boundary
        # As if a line ended before the body: its first line may be a boundary.
        self._waiting = bytearray(b"\n")
        self._no_content = 1
        """Bytes at the start of those waiting that are no content: the end of the line before it."""
        self._parts = 0
        self._in_part = self._in_headers = self._ended = False
        self._line_feeds_alone = False

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
        with memoryview(data) as view:
            for start in range(0, len(data), _PIECE_BYTES):
                if self._ended:
                    return
                self._waiting += view[start : start + _PIECE_BYTES]
                while not self._ended and (self._read_headers() if self._in_headers else self._read_content()):
                    pass

    def check_end(self) -> None:
        """Check that the body has come to its closing boundary.

        Raises
        ------
        Problem
            400 ``malformed``.
        """
        if not (self._ended or self._in_part or self._in_headers):
            raise malformed("The body lacks the boundary that its content type names; name the boundary of the body.")
        if not self._ended:
            raise malformed("The body ends before its closing boundary; send the request again.")

    def _read_content(self) -> bool:
        """Pass content on up to the next boundary; return whether the boundary was there."""
        waiting, delimiter = self._waiting, self._delimiter
        at = waiting.find(delimiter)
        while at >= 0:
            after = at + len(delimiter)
            if waiting.startswith(b"--", after):
                self._pass_on(at, is_end=True)
                self._ended = True
                return True
            line_end = waiting.find(b"\n", after, after + LONGEST_PADDING)
            if line_end >= 0 and not waiting[after:line_end].strip(b" \t\r"):
                self._line_feeds_alone = waiting[line_end - 1] != ord("\r")
                line_bytes = line_end + 1 - at
                self._pass_on(at, is_end=True)
                del waiting[:line_bytes]
                self._in_headers = True
                return True
            if line_end < 0 and len(waiting) < after + LONGEST_PADDING:
                break
            at = waiting.find(delimiter, after)
        # The last bytes may be the beginning of a boundary and of the line end before it.
        self._pass_on((len(waiting) - len(delimiter) if at < 0 else at) - 1, is_end=False)
        return False

    def _pass_on(self, count: int, *, is_end: bool) -> None:
        """Give the first bytes of those waiting to the part, and forget them."""
        if count < self._no_content and not is_end:
            return
        waiting, start = self._waiting, self._no_content
        if self._in_part:
            # The line end before a boundary belongs to the boundary.
            ends_line = is_end and not self._line_feeds_alone and count > start and waiting[count - 1] == ord("\r")
            with memoryview(waiting) as view:
                content = bytes(view[start : count - 1 if ends_line else count])
            if content:
                self.add(content)
            if is_end:
                self.end_part()
                self._in_part = False
        del waiting[:count]
        self._no_content = 0

    def _read_headers(self) -> bool:
        """Read the headers of a part; return whether they are complete."""
        found = _BLANK_LINE.search(self._waiting, 0, LONGEST_HEADERS)
        if found is None:
            if len(self._waiting) >= LONGEST_HEADERS:
                raise malformed(f"A part has headers of more than {LONGEST_HEADERS} bytes; send shorter ones.")
            return False
        headers = _headers(bytes(self._waiting[: found.start()]))
        self._parts += 1
        if self._parts > MOST_PARTS:
            raise Problem(
                413, "too_many_parts", f"A request may have {MOST_PARTS} parts; send the rest in another request."
            )
        # The end of the blank line waits on: behind an empty part it is the line end before the boundary.
        del self._waiting[: found.end() - 1]
        self._no_content = 1
        self._in_headers, self._in_part = False, True
        self.begin_part(headers)
        return True


def _headers(lines: bytes) -> dict[bytes, bytes]:
    """Return the headers of a part; a line that begins with a blank continues the one before (RFC 5322 section 2.2.3)."""
    headers: dict[bytes, bytes] = {}
    for line in _FOLD.sub(b" ", lines).splitlines():
        name, colon, value = line.partition(b":")
        if not colon or not name.strip():
            raise malformed("A part has a line among its headers that is none; end the headers with a blank line.")
        headers[name.strip().lower()] = value.strip()
    return headers


def malformed(detail: str) -> Problem:
    """Return the problem of a broken multipart body."""
    return Problem(400, "malformed", detail)
