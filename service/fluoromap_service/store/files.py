"""Content-addressed files.

The store writes a file under a temporary name, flushes it to disk, renames it to its hash and commits its row. So nobody sees
a half-written file. A store on other media would need this interface and no more.
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
_FILES_LOCK = 0x66696C65  # "file" in ASCII; any number that no other lock of this database uses


def path_of(sha256: str) -> Path:
    """Return the path for the content with this hash; the file need not exist."""
    return settings().files_dir / sha256[:2] / sha256


@contextmanager
def incoming() -> Iterator[Path]:
    """Give a path on the store's own disk for an arriving file.

    The file is removed at the end unless it was kept.
    """
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
    """Return the hash of a file's content."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def lock(session: Session) -> None:
    """Keep other transactions from adding and removing files until this one ends.

    SQLite has only one writer at a time, so it needs no lock.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _FILES_LOCK})


def keep(session: Session, path: Path, *, sha256: str | None = None) -> str:
    """Move an incoming file to its content address; return its hash.

    The file's row is added. A caller that knows the hash gives it. Then the transaction does not read a long file
    again.
    """
    sha256 = sha256 or sha256_of(path)
    lock(session)
    target = path_of(sha256)
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
        session.add(File(sha256=sha256))
        session.flush()
    return sha256


def keep_bytes(session: Session, content: bytes) -> str:
    """Store bytes as :func:`keep` does a file."""
    with incoming() as path:
        path.write_bytes(content)
        return keep(session, path)


def remove_unreferenced(session: Session, candidates: Iterable[str]) -> list[Path]:
    """Delete the rows of the files that no other row refers to.

    Returns
    -------
    list of Path
        The files without a row; the caller removes them after the commit.
    """
    unreferenced: list[Path] = []
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
            unreferenced.append(path_of(sha256))
    return unreferenced
