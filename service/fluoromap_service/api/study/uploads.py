"""Uploaded files, written to the store's disk while they arrive."""

from __future__ import annotations

import asyncio
import functools
import hashlib
import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi import Request
from python_multipart.multipart import parse_options_header
from starlette.requests import ClientDisconnect

from fluoromap_service.api.http.multipart import MultipartBody
from fluoromap_service.problem import Problem
from fluoromap_service.store import disk, files
from fluoromap_service.store.names import normal_name

PART_BYTES = 2 << 20
"""Bytes of a body that a thread writes at once: each change of threads costs time."""

UPLOAD_THREADS = 32
_LONGEST_FIELD = 1024

Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class Part:
    """One complete uploaded file. ``file_name`` may name the patient: never use it in a log, path or error."""

    path: Path
    sha256: str
    file_name: str | None


@dataclass(slots=True)
class ArrivingPart:
    """A file of a request that is being written."""

    path: Path
    file_name: str | None
    stream: BinaryIO
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)

    def write(self, data: bytes) -> None:
        self.stream.write(data)
        self.digest.update(data)

    def finish(self) -> Part:
        # Flush it now, so that the transaction that keeps the file need not wait for the disk.
        self.stream.flush()
        os.fsync(self.stream.fileno())
        self.stream.close()
        return Part(self.path, self.digest.hexdigest(), self.file_name)


class _Form(MultipartBody):
    """A form: its parts named ``file`` go to disk, its field ``site`` to memory."""

    def __init__(self, boundary: bytes | None, stack: ExitStack) -> None:
        super().__init__(boundary)
        self._stack = stack
        self._arriving: ArrivingPart | None = None
        self._text: bytearray | None = None
        self.files: list[Part] = []
        self.site: str | None = None

    def begin_part(self, headers: dict[bytes, bytes]) -> None:
        _, options = parse_options_header(headers.get(b"content-disposition"))
        name = options.get(b"name", b"").decode("utf-8", "replace")
        if name == "file":
            sent_name = options.get(b"filename")
            file_name = None if sent_name is None else sent_name.decode("utf-8", "replace")
            self._arriving = arriving_file(self._stack, file_name)
        elif name == "site":
            self._text = bytearray()
        else:
            raise Problem(
                422, "unknown_part", "Only parts named 'file' and one field named 'site' are allowed; rename the other parts.",
                [("multipart/form-data", "a part with another name, or without one")],
            )  # fmt: skip

    def add(self, data: bytes) -> None:
        if self._arriving is not None:
            self._arriving.write(data)
        elif self._text is not None:
            self._text += data
            if len(self._text) > _LONGEST_FIELD:
                raise Problem(
                    422,
                    "invalid_site",
                    "The field 'site' is too long; a name has at most 64 characters.",
                    [("site", "too long")],
                )

    def end_part(self) -> None:
        if self._arriving is not None:
            self.files.append(self._arriving.finish())
        elif self._text is not None:
            try:
                self.site = normal_name(self._text.decode())
            except UnicodeDecodeError:
                raise Problem(
                    400, "malformed", "The field 'site' is not UTF-8; send it in UTF-8.", [("site", "not UTF-8")]
                ) from None
        self._arriving = self._text = None


def arriving_file(stack: ExitStack, file_name: str | None) -> ArrivingPart:
    """Return a new file of the store.

    At its end ``stack`` removes the file unless the store kept it.
    """
    path = stack.enter_context(files.incoming())
    return ArrivingPart(path, file_name and normal_name(file_name)[:1000], stack.enter_context(path.open("wb")))


async def receive(request: Request, stack: ExitStack) -> tuple[list[Part], str | None]:
    """Receive the files of a request and its field ``site``.

    At its end ``stack`` removes the files that the store did not keep.

    Raises
    ------
    Problem
        400 for a malformed or truncated body, 413, 415 for another content type, 422 for a part of another name.
    """
    kind, options = parse_options_header(request.headers.get("content-type"))
    try:
        if kind == b"application/dicom":
            return [await _receive_raw(request, stack)], None
        if kind == b"multipart/form-data":
            form = _Form(options.get(b"boundary"), stack)
            await write_all(request, form.write)
            form.check_end()
            return form.files, form.site
    except ClientDisconnect:
        raise Problem(400, "truncated", "The connection ended before the body; send the request again.") from None
    raise Problem(415, "unsupported_media_type", "Send DICOM files as multipart/form-data or application/dicom.")


async def _receive_raw(request: Request, stack: ExitStack) -> Part:
    arriving = arriving_file(stack, None)
    await write_all(request, arriving.write)
    return await in_upload_thread(arriving.finish)


async def write_all(request: Request, write: Callable[[bytes], None]) -> None:
    """Write a body; further chunks arrive while a thread writes those before."""
    waiting: list[bytes] = []
    waiting_bytes = 0
    writing: asyncio.Task[None] | None = None
    try:
        async for chunk in request.stream():
            waiting.append(chunk)
            waiting_bytes += len(chunk)
            if waiting_bytes >= PART_BYTES:
                if writing is not None:
                    await writing
                writing = asyncio.create_task(in_upload_thread(_write_chunks, write, waiting, waiting_bytes))
                waiting, waiting_bytes = [], 0
    finally:
        # Nobody may close the file under the thread that writes it.
        if writing is not None:
            await asyncio.wait({writing})
    if writing is not None:
        writing.result()
    if waiting:
        await in_upload_thread(_write_chunks, write, waiting, waiting_bytes)


def _write_chunks(write: Callable[[bytes], None], chunks: list[bytes], size: int) -> None:
    disk.check_room(size)
    for chunk in chunks:
        write(chunk)


async def in_upload_thread(function: Callable[..., Answer], *arguments: Any) -> Answer:
    """Call a function in a thread of the uploads.

    They need not wait for the threads of readers.
    """
    return await to_thread.run_sync(function, *arguments, limiter=_threads())


@functools.cache
def _threads() -> CapacityLimiter:
    return CapacityLimiter(UPLOAD_THREADS)
