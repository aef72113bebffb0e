"""The headers that ``benchmarks/fuzz.py`` draws: they are files, differ from the original, and come again with the seed."""

from __future__ import annotations

import io
import random
from pathlib import Path

import odd_headers
import pydicom
import pytest

CORPUS = sorted((Path(__file__).parent.parent / "corpus").glob("*.dcm"))


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.stem)
def test_headers_are_odd_and_come_again(path: Path) -> None:
    content = path.read_bytes()
    drawn = [odd_headers.odd_header(random.Random(seed), content) for seed in range(60)]
    assert drawn == [odd_headers.odd_header(random.Random(seed), content) for seed in range(60)]
    assert len(set(drawn)) == 60
    for each in drawn:
        assert pydicom.dcmread(io.BytesIO(each), specific_tags=["SOPInstanceUID"]).file_meta.TransferSyntaxUID


def test_every_kind_is_drawn() -> None:
    content = CORPUS[0].read_bytes()
    drawn = b"".join(odd_headers.odd_header(random.Random(seed), content) for seed in range(400))
    for sign in (b"ISO 2022 IR 87", b"NaN", b"\xfe\xff\xdd\xe0\x00\x00\x00\x00", b"ZZ\x04\x00abcd", b"10:11:12"):
        assert sign in drawn, sign
