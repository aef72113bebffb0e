"""The route of a job's archive."""

from __future__ import annotations

import io
import itertools
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, cast

from fastapi.responses import StreamingResponse

from fluoromap_service.api.http.middleware.download_limit import LARGE_DOWNLOAD
from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.http.spooled_answers import PIECE_BYTES
from fluoromap_service.api.results.archive_files import ArchiveFile, archive_files
from fluoromap_service.store import disk

router = new_router(tags=["results"])

_DATE = (1980, 1, 1, 0, 0, 0)
"""The date of every file in the archive, so that the same results give the same bytes."""

_LEVEL = 1
"""Compression of the tables: a higher level takes several times as long and saves a fifth."""


@router.get(
    "/v1/jobs/{job_id}/archive.zip",
    dependencies=[LARGE_DOWNLOAD],
    summary="Everything in one file",
    response_class=StreamingResponse,
    responses={
        200: {
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
            "description": "A zip.",
        },
        **responses(401, 403, 404, 409, 422, 429),
    },
)
def get_archive(job_id: JobId, caller: Reader) -> StreamingResponse:
    """Return all results of a job in one zip.

    The answer is 409 until the job has ended. The zip contains `job.json`, `parameters.json`, `points.csv`,
    `tracks.csv`, `report.html`, `map.json`, `map.png`, the mesh in all formats and an overlay of each view of each
    site, as far as the job has these results. Coordinates count from the reference catheter. The archive is sent while it is
    made, so its length is not known at the start.
    """
    # Its pictures and tables are made on the way, and then it is too late for a problem.
    disk.check_room()
    files = archive_files(job_id)
    # The first file before the status: a job that has not ended is a problem, not an archive.
    first = next(files)
    headers = {"Content-Disposition": f'attachment; filename="fluoromap-{job_id}.zip"'}
    return StreamingResponse(_zipped(itertools.chain([first], files)), 200, headers, "application/zip")


class _Outflow:
    """The end of a stream that the archive is written into; it cannot seek."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    def write(self, content: bytes) -> int:
        self._waiting += content
        return len(content)

    def flush(self) -> None:
        """Do nothing: the reader takes the bytes when it is ready."""

    @property
    def waiting(self) -> int:
        """Number of bytes that nobody has taken."""
        return len(self._waiting)

    def take(self) -> bytes:
        """Return the bytes that were written since the last call."""
        content = bytes(self._waiting)
        self._waiting.clear()
        return content


def _zipped(files: Iterable[ArchiveFile]) -> Iterator[bytes]:
    """Return a zip of the files, piece by piece.

    An error in the middle ends the connection, so that a client does not take a part for the whole.
    """
    outflow = _Outflow()
    with zipfile.ZipFile(cast(IO[bytes], outflow), "w") as archive:
        for file in files:
            entry = zipfile.ZipInfo(file.name, _DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED if file.compress else zipfile.ZIP_STORED
            entry.external_attr = 0o644 << 16
            # Only writestr has an argument for it, and that takes the whole content.
            entry._compresslevel = _LEVEL  # type: ignore[attr-defined]
            # A table of a study has 70 MB, so it is read and sent in pieces.
            with _opened(file.content) as content:
                entry.file_size = content.seek(0, io.SEEK_END)
                content.seek(0)
                with archive.open(entry, "w") as member:
                    while piece := content.read(PIECE_BYTES):
                        member.write(piece)
                        if outflow.waiting >= PIECE_BYTES:
                            yield outflow.take()
            yield outflow.take()
    yield outflow.take()


def _opened(content: bytes | Path) -> IO[bytes]:
    return content.open("rb") if isinstance(content, Path) else io.BytesIO(content)
