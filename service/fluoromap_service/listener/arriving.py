"""The file of an object that is arriving by C-STORE, written while it arrives."""

from __future__ import annotations

import fcntl
import hashlib
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from fluoromap_service.settings import settings
from fluoromap_service.store import disk, files

BUFFER_BYTES = 1 << 20
"""Bytes that are written to the disk at once."""


class ArrivingFile:
    """A temporary file of the store for one object.

    pynetdicom makes it in place of its own ``NamedTemporaryFile``, with the same members. The file is removed when it is
    closed or forgotten, also after an aborted association, unless the store has moved it. The lock lets a clean-up
    recognise the files of a process that was killed.
    """

    def __init__(self, **options: Any) -> None:
        folder = files.made_incoming_folder()
        self._stream = tempfile.NamedTemporaryFile(dir=folder, buffering=BUFFER_BYTES)  # noqa: SIM115
        fcntl.flock(self._stream.fileno(), fcntl.LOCK_SH)
        self._digest = hashlib.sha256()
        self._size = self._checked_size = 0
        self.too_large = False
        self.disk_full = False

    @property
    def name(self) -> str:
        """Path of the file."""
        return self._stream.name

    @property
    def path(self) -> Path:
        """Path of the file."""
        return Path(self._stream.name)

    @property
    def file(self) -> ArrivingFile:
        """The stream that pynetdicom flushes after each fragment."""
        return self

    @property
    def sha256(self) -> str:
        """Hash of all written bytes."""
        return self._digest.hexdigest()

    def write(self, data: bytes) -> int:
        """Add bytes and return their number.

        The bytes of an object that is too large for the service or the disk are dropped. An exception here would end the
        thread that also answers the sender, so the handler reads ``too_large`` and ``disk_full``.
        """
        self._size += len(data)
        self.too_large = self.too_large or self._size > settings().max_upload_bytes
        if self.too_large or self.disk_full:
            self._empty()
            return len(data)
        try:
            if self._size - self._checked_size > BUFFER_BYTES:
                disk.check_room(BUFFER_BYTES)
                self._checked_size = self._size
            self._stream.write(data)
            self._digest.update(data)
        except OSError:
            self.disk_full = True
            self._empty()
        return len(data)

    def _empty(self) -> None:
        # The space is free again while the rest of the object arrives.
        with suppress(OSError):
            self._stream.seek(0)
            self._stream.truncate()

    def flush(self) -> None:
        """Do nothing: writing after each fragment of 16 KiB would be slow."""

    def finish(self) -> None:
        """Write the rest to the disk.

        Raises
        ------
        OSError
            When the disk is full.
        """
        self._stream.flush()

    def close(self) -> None:
        """Remove the file, unless the store has moved it."""
        with suppress(OSError):
            self._stream.close()
