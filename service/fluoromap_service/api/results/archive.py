"""The route of a job's archive."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Iterator
from typing import IO

from fastapi import APIRouter
from fastapi.responses import StreamingResponse
from starlette.background import BackgroundTask

from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.results.archive_files import archive_files
from fluoromap_service.settings import settings
from fluoromap_service.store.files import CHUNK_BYTES

router = APIRouter(tags=["results"])

_DATE = (1980, 1, 1, 0, 0, 0)
"""The date of every file in the archive, so that the same results give the same bytes."""


@router.get(
    "/v1/jobs/{job_id}/archive.zip",
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
    site, as far as the job has these results. Coordinates count from the reference catheter.
    """
    folder = settings().files_dir / "incoming"
    folder.mkdir(parents=True, exist_ok=True)
    stream = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - the background task closes it after the answer
    try:
        with zipfile.ZipFile(stream, "w") as archive:
            for file in archive_files(job_id):
                entry = zipfile.ZipInfo(file.name, _DATE)
                entry.compress_type = zipfile.ZIP_DEFLATED if file.compress else zipfile.ZIP_STORED
                entry.external_attr = 0o644 << 16
                archive.writestr(entry, file.content)
        size = stream.tell()
        stream.seek(0)
    except BaseException:
        stream.close()
        raise
    headers = {"Content-Disposition": f'attachment; filename="fluoromap-{job_id}.zip"', "Content-Length": str(size)}
    return StreamingResponse(_chunks(stream), 200, headers, "application/zip", BackgroundTask(stream.close))


def _chunks(stream: IO[bytes]) -> Iterator[bytes]:
    while chunk := stream.read(CHUNK_BYTES):
        yield chunk
