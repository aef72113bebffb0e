"""Multipart bodies as RFC 2046 section 5.1.1 allows them, in any pieces."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluoromap_service.api.http.multipart import LONGEST_HEADERS, MOST_PARTS, MultipartBody
from fluoromap_service.problem import Problem


class Collected(MultipartBody):
    """Keeps the headers and the content of each part."""

    def __init__(self, boundary: bytes | None) -> None:
        super().__init__(boundary)
        self.parts: list[tuple[dict[bytes, bytes], bytes]] = []
        self._headers: dict[bytes, bytes] = {}
        self._content = b""

    def begin_part(self, headers: dict[bytes, bytes]) -> None:
        self._headers, self._content = headers, b""

    def add(self, data: bytes) -> None:
        self._content += data

    def end_part(self) -> None:
        self.parts.append((self._headers, self._content))


def read(
    body: bytes, boundary: bytes | None = b"XB", piece: int | None = None
) -> list[tuple[dict[bytes, bytes], bytes]]:
    collected = Collected(boundary)
    for start in range(0, len(body), piece or max(len(body), 1)):
        collected.write(body[start : start + (piece or len(body))])
    collected.check_end()
    return collected.parts


TYPE = {b"content-type": b"application/dicom"}
PART = b"Content-Type: application/dicom\r\n\r\none\r\ntwo"


@pytest.mark.parametrize(
    "body",
    [
        b"--XB\r\n" + PART + b"\r\n--XB--\r\n",
        b"--XB\r\n" + PART + b"\r\n--XB--",
        b"A preamble that readers ignore\r\n--XB\r\n" + PART + b"\r\n--XB--\r\n",
        b"\r\n--XB\r\n" + PART + b"\r\n--XB--\r\n",
        b"--XBC\r\nan odd preamble --XB\r\n--XB\r\n" + PART + b"\r\n--XB--\r\n",
        b"--XB \r\n" + PART + b"\r\n--XB--\r\n",
        b"--XB\t  \r\n" + PART + b"\r\n--XB-- \t\r\n",
        b"--XB\r\n" + PART + b"\r\n--XB--\r\nAn epilogue.\r\n--XB\r\n" + PART,
        b"--XB\r\ncontent-TYPE :  application/dicom \r\n\r\none\r\ntwo\r\n--XB--",
        b"--XB\r\nContent-Type:\r\n application/dicom\r\n\r\none\r\ntwo\r\n--XB--",
        b"--XB\r\nContent-Type:\r\n\tapplication/dicom\r\n\r\none\r\ntwo\r\n--XB--",
    ],
)
@pytest.mark.parametrize("piece", [None, 1, 2, 3, 7])
def test_the_same_part_in_other_words(body: bytes, piece: int | None) -> None:
    assert read(body, piece=piece) == [(TYPE, b"one\r\ntwo")]


@pytest.mark.parametrize("piece", [None, 1, 5])
def test_lines_that_end_with_a_line_feed_alone(piece: int | None) -> None:
    body = b"preamble\n--XB\nContent-Type: application/dicom\n\none\r\ntwo\r\n--XB \nX: y\n\n\n--XB--\n"
    assert read(body, piece=piece) == [(TYPE, b"one\r\ntwo\r"), ({b"x": b"y"}, b"")]


@pytest.mark.parametrize("piece", [None, 1, 2])
@pytest.mark.parametrize(
    "content", [b"", b"\r", b"\n", b"\r\n", b"\r\n--X", b"\r\n--XBC", b"-XB", b"\n--XB.", b"\r\n--XB\0"]
)
def test_content_that_resembles_a_boundary(content: bytes, piece: int | None) -> None:
    body = b"--XB\r\nX: y\r\n\r\n" + content + b"\r\n--XB\r\n\r\n" + content + b"\r\n--XB--"
    assert read(body, piece=piece) == [({b"x": b"y"}, content), ({}, content)]


def test_an_empty_part_may_lack_its_own_line_end() -> None:
    assert read(b"--XB\r\nX: y\r\n\r\n--XB\r\n\r\n--XB--") == [({b"x": b"y"}, b""), ({}, b"")]


def test_a_length_in_a_part_does_not_count() -> None:
    """RFC 2046 ends a part by its boundary only; a wrong length harms nobody."""
    body = b"--XB\r\nContent-Length: 2\r\n\r\nthree\r\n--XB--"
    assert read(body) == [({b"content-length": b"2"}, b"three")]


@given(
    contents=st.lists(st.lists(st.sampled_from([b"\r", b"\n", b"--", b"XB", b"-", b"a", b"\0"])).map(b"".join), max_size=4),
    cuts=st.lists(st.integers(1, 9), min_size=1),
)  # fmt: skip
def test_any_content_in_any_pieces(contents: list[bytes], cuts: list[int]) -> None:
    boundary = b"XB-7f"
    body = b"".join(b"--XB-7f\r\nX: y\r\n\r\n" + content + b"\r\n" for content in contents) + b"--XB-7f--\r\n"
    collected = Collected(boundary)
    start = 0
    while start < len(body):
        for cut in cuts:
            collected.write(body[start : start + cut])
            start += cut
    collected.check_end()
    assert [content for _, content in collected.parts] == contents


@pytest.mark.parametrize(
    ("boundary", "body", "words"),
    [
        (None, b"--XB--", "names no boundary"),
        (b"", b"--XB--", "names no boundary"),
        (b"XB", b"", "lacks the boundary"),
        (b"XB", b"--other\r\n\r\nx\r\n--other--", "lacks the boundary"),
        (b"XB", b"text --XB\r\n", "lacks the boundary"),
        (b"XB", b"--XB\r\n" + PART, "before its closing boundary"),
        (b"XB", b"--XB\r\n" + PART + b"\r\n--XB\r\n", "before its closing boundary"),
        (b"XB", b"--XB\r\n" + PART + b"\r\n--XB-", "before its closing boundary"),
        (b"XB", b"--XB\r\nno header\r\n\r\nx\r\n--XB--", "a line among its headers"),
        (b"XB", b"--XB\r\nX: y\r\n--XB--\r\n\r\n", "a line among its headers"),
        (b"XB", b"--XB\r\n folded\r\n\r\nx\r\n--XB--", "a line among its headers"),
        (b"XB", b"--XB\r\nX: " + bytes(LONGEST_HEADERS), "headers of more than"),
    ],
)
def test_broken_bodies_are_named(boundary: bytes | None, body: bytes, words: str) -> None:
    with pytest.raises(Problem, match=words) as caught:
        read(body, boundary, piece=5)
    assert (caught.value.status, caught.value.code) == (400, "malformed")


def test_too_many_parts() -> None:
    collected: Any = Collected(b"XB")
    with pytest.raises(Problem) as caught:
        collected.write(b"--XB\r\n\r\n" * (MOST_PARTS + 1))
    assert caught.value.status == 413


def test_waiting_bytes_do_not_grow_with_the_body() -> None:
    collected = Collected(b"XB")
    collected.write(b"--XB\r\n\r\n")
    for _ in range(50):
        collected.write(bytes(10_000))
        assert len(collected._waiting) < 100
