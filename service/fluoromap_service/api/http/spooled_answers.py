"""Answers that the service makes whole before it sends the first byte, without holding them in memory."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from typing import IO

from fastapi import Response
from fastapi.responses import StreamingResponse

from fluoromap_service.store import disk, files

PIECE_BYTES = 1 << 18
"""The server sends each piece from another thread, so small pieces take longer."""
_IN_MEMORY_BYTES = 1 << 20
"""A longer answer waits on the disk."""


def spooled_answer(pieces: Iterable[bytes], media_type: str, headers: Mapping[str, str]) -> Response:
    """Return an answer of these pieces, which are all made first.

    An error while they are made is an error of the answer, and so is a disk that has only its reserve left. The length of the
    answer is known. A long answer waits in a file without a name, which ends with the answer.
    """
    spool = tempfile.SpooledTemporaryFile(_IN_MEMORY_BYTES, dir=str(files.made_incoming_folder()))  # noqa: SIM115
    try:
        # Not writelines: it looks at the length only after the last piece.
        for piece in pieces:
            if spool.tell() + len(piece) > _IN_MEMORY_BYTES:
                disk.check_room(len(piece))
            spool.write(piece)
    except BaseException:
        spool.close()
        raise
    headers = {**headers, "Content-Length": str(spool.tell())}
    spool.seek(0)
    return StreamingResponse(_pieces_of(spool), 200, headers, media_type)


def _pieces_of(spool: IO[bytes]) -> Iterator[bytes]:
    with spool:
        while piece := spool.read(PIECE_BYTES):
            yield piece
