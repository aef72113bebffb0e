"""Numbers in text, a line for each sample: read piece by piece, with the place of the first wrong line."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from fluoromap.signals.recording import NotARecording

Array = NDArray[np.float64]

_PIECE_BYTES = 4 * 2**20
_LONGEST_LINE_BYTES = 2**16
_NEWLINE = ord("\n")


@dataclass(frozen=True, slots=True)
class SampleTable:
    """A table of numbers in a text file.

    Parameters
    ----------
    path : Path
    start : int
        Byte of the first sample's line.
    first_line : int
        Number of that line in the file, from 1, for messages.
    columns : int
        Numbers in each line.
    separator : str
        Character between two numbers; a blank stands for any number of blanks and tabs.
    decimal_comma : bool
        Whether a comma is the decimal sign.
    skipped : int
        Columns before the samples that may hold anything, such as a time of day.
    """

    path: Path
    start: int
    first_line: int
    columns: int
    separator: str
    decimal_comma: bool = False
    skipped: int = 0

    def pieces(self) -> Iterator[Array]:
        """Yield the table piece by piece, (n, columns).

        Raises
        ------
        NotARecording
            When a line has more or fewer numbers, or anything else.
        """
        line = self.first_line
        with self.path.open("rb") as stream:
            stream.seek(self.start)
            for lines in _whole_lines(stream):
                numbers = self._parse(lines, line)
                line += lines.count(b"\n")
                if len(numbers):
                    yield numbers

    def count_lines(self) -> int:
        """Return the number of lines that are not empty."""
        count = 0
        with self.path.open("rb") as stream:
            stream.seek(self.start)
            for lines in _whole_lines(stream):
                count += len(_numbers_in_lines(lines, self.separator))
        return count

    def _parse(self, lines: bytes, line: int) -> Array:
        text = lines.replace(b"\r", b"")
        if self.skipped:
            text = re.sub(rb"(?m)^(?:[^\n%s]*%s){%d}" % ((self.separator.encode(),) * 2 + (self.skipped,)), b"", text)
        if self.decimal_comma:
            text = text.replace(b",", b".")
        counts = _numbers_in_lines(text, self.separator)
        if (counts != self.columns).any():
            return self._find_fault(lines, line)
        if self.separator != " ":
            # A line may end with a separator; of a blank line nothing is left.
            mark = self.separator.encode()
            text = re.sub(rb"%s?[ \t]*\n\s*" % mark, mark, text).rstrip(mark + b" \t")
        with warnings.catch_warnings():
            # NumPy reports a text that it cannot read to its end as a deprecated use.
            warnings.simplefilter("error", DeprecationWarning)
            try:
                numbers = np.fromstring(text, np.float64, sep=self.separator)
            except (DeprecationWarning, ValueError):
                return self._find_fault(lines, line)
        if len(numbers) != counts.sum() or not np.isfinite(numbers).all():
            return self._find_fault(lines, line)
        return numbers.reshape(-1, self.columns)

    def _find_fault(self, lines: bytes, line: int) -> Array:
        """Read line by line, and name the first that is wrong."""
        rows = []
        for number, each in enumerate(lines.splitlines(), line):
            text = each.decode("latin-1").strip()
            if not text:
                continue
            parts = text.split() if self.separator == " " else text.removesuffix(self.separator).split(self.separator)
            parts = parts[self.skipped :]
            try:
                values = [float(part.replace(",", ".") if self.decimal_comma else part) for part in parts]
            except ValueError:
                raise NotARecording(
                    f"Line {number} holds something that is no number; export the recording again."
                ) from None
            if len(values) != self.columns:
                raise NotARecording(
                    f"Line {number} has {len(values)} samples, and the header announces {self.columns} channels; "
                    "export the recording again."
                )
            if not np.isfinite(values).all():
                raise NotARecording(f"Line {number} has a sample that is not finite; export the recording again.")
            rows.append(values)
        return np.array(rows).reshape(len(rows), self.columns)


def _whole_lines(stream: BinaryIO) -> Iterator[bytes]:
    rest = b""
    while piece := stream.read(_PIECE_BYTES):
        piece = rest + piece
        end = piece.rfind(b"\n") + 1
        rest = piece[end:]
        if len(rest) > _LONGEST_LINE_BYTES:
            raise NotARecording(
                f"A line has more than {_LONGEST_LINE_BYTES} bytes; export the recording as text again."
            )
        if end:
            yield piece[:end]
    if rest.strip(b"\x1a\0 \t\r\n"):
        yield rest + b"\n"


def _numbers_in_lines(lines: bytes, separator: str) -> NDArray[np.int64]:
    """Return how many numbers each line has, without the empty lines."""
    content = np.frombuffer(lines, np.uint8)
    is_gap = np.isin(content, np.frombuffer(f" \t\r\n{separator}".encode(), np.uint8))
    begins = ~is_gap
    begins[1:] &= is_gap[:-1]
    counts = np.diff(np.cumsum(begins)[content == _NEWLINE], prepend=0)
    found: NDArray[np.int64] = counts[counts > 0]
    return found
