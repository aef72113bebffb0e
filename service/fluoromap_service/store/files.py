"""Content-addressed files: written beside, flushed to disk, renamed to their hash, then committed as a row.

Nothing half-written is ever visible. The one interface that a store on other media would have to offer.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import delete, exists, select, text
from sqlalchemy.orm import Session

from fluoromap_service.settings import settings
from fluoromap_service.store.models import File, Instance, Rendering, StageResult, StageRow

CHUNK_BYTES = 1 << 20
_FILES_LOCK = 0x66696C65  # "file": any number that nobody else takes in this database


def path_of(sha256: str) -> Path:
    """Where the file of that content stands, whether or not it exists."""
    return settings().files_dir / sha256[:2] / sha256


@contextmanager
def incoming() -> Iterator[Path]:
    """A path for a file that is still arriving, on the store's own disk; removed at the end if nobody kept it."""
    folder = settings().files_dir / "incoming"
    folder.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=folder)
    os.close(handle)
    path = Path(name)
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


def sha256_of(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def lock(session: Session) -> None:
    """Hold off others that add or remove files until this transaction ends; SQLite's writers are alone already."""
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _FILES_LOCK})


def keep(session: Session, path: Path, media_type: str, sha256: str | None = None) -> str:
    """Move an incoming file to its content address and add its row to the session. Returns the hash.

    A caller that knows the file's hash already gives it, so that a long file is not read again inside the transaction.
    """
    sha256 = sha256 or sha256_of(path)
    lock(session)
    target = path_of(sha256)
    size = path.stat().st_size
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        with path.open("rb") as stream:
            os.fsync(stream.fileno())
        path.replace(target)
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    if session.get(File, sha256) is None:
        session.add(File(sha256=sha256, size=size, media_type=media_type))
        session.flush()
    return sha256


def keep_bytes(session: Session, content: bytes, media_type: str) -> str:
    """As :func:`keep`, for bytes in memory."""
    with incoming() as path:
        path.write_bytes(content)
        return keep(session, path, media_type)


def remove_unreferenced(session: Session, candidates: Iterable[str]) -> list[Path]:
    """Delete the rows of those files that no other row refers to; the caller unlinks the paths after commit."""
    gone: list[Path] = []
    for sha256 in set(candidates):
        session.execute(
            delete(StageResult).where(
                StageResult.sha256 == sha256, ~exists(select(StageRow.id).where(StageRow.result == sha256))
            )
        )
        used = (
            select(Instance.sha256).where(Instance.sha256 == sha256),
            select(StageRow.result).where(StageRow.result == sha256),
            select(StageResult.sha256).where(StageResult.sha256 == sha256),
            select(Rendering.sha256).where(Rendering.sha256 == sha256),
        )
        if not any(session.execute(query.limit(1)).first() for query in used):
            session.execute(delete(File).where(File.sha256 == sha256))
            gone.append(path_of(sha256))
    return gone
