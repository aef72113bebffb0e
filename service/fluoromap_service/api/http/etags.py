"""Entity tags: the service does not send an unchanged answer again (RFC 9110 section 13.1.2)."""

from __future__ import annotations

from pathlib import Path

from fastapi import Request, Response
from fastapi.responses import FileResponse


class _StoredFile(FileResponse):
    """A stored file. Most of them are sent in one piece, because each piece waits for a thread."""

    chunk_size = 1 << 20


def is_known(request: Request, etag: str) -> bool:
    """Return whether the client has this version already.

    The comparison is weak, as If-None-Match demands (RFC 9110 section 8.8.3.2).
    """
    header = request.headers.get("if-none-match")
    if header is None:
        return False
    sent = {tag.strip().removeprefix("W/") for tag in header.split(",")}
    return "*" in sent or etag.removeprefix("W/") in sent


def not_modified(etag: str) -> Response:
    """Return 304 with the entity tag."""
    return Response(status_code=304, headers={"ETag": etag})


def file_response(
    request: Request, path: Path, sha256: str, media_type: str, file_name: str, *, inline: bool = False
) -> Response:
    """Return a stored file with its hash as entity tag, or 304."""
    etag = f'"{sha256}"'
    headers = {"ETag": etag, "Cache-Control": "private, no-cache"}
    if is_known(request, etag):
        return Response(status_code=304, headers=headers)
    disposition = "inline" if inline else "attachment"
    return _StoredFile(
        path, media_type=media_type, filename=file_name, headers=headers, content_disposition_type=disposition
    )
