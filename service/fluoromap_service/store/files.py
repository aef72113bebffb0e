"""Content-addressed files.

The store writes a file under a temporary name, flushes it to disk, renames it to its hash and commits its row. So nobody sees
a half-written file. A reader asks for a file by its hash and gets it only when the content still has that hash. A store on
other media would need this interface and no more.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

from sqlalchemy import bindparam, delete, exists, select, text
from sqlalchemy.orm import Session

from fluoromap_service.settings import settings
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import File, Instance, Rendering, StageResult, StageRow
from fluoromap_service.store.private_folder import make_private_folder

CHUNK_BYTES = 1 << 20
ABANDONED_SECONDS = 5.0
"""Age of an incoming file without a lock at which nobody can be about to lock it."""
_REMEMBERED_CHECKS = 4096
_LONG_BYTES = 1 << 20
"""A query of the database takes as long as reading and hashing a file of this size."""
_RECENT_NS = 3600 * 10**9
"""What was flushed within an hour is believed to be on disk as it was written; later a disk may have decayed."""
_FILES_LOCK = 0x66696C65  # "file" in ASCII; any number that no other lock of this database uses
_checked: OrderedDict[str, tuple[int, ...]] = OrderedDict()
_checked_lock = threading.Lock()


class BrokenFile(Exception):
    """A stored file is missing, or its content no longer has the hash of its address."""

    def __init__(self, sha256: str) -> None:
        super().__init__(f"the stored file {sha256} is missing or damaged")
        self.sha256 = sha256

    def __reduce__(self) -> tuple[type[BrokenFile], tuple[str]]:
        return BrokenFile, (self.sha256,)


def path_of(sha256: str) -> Path:
    """Return the path for the content with this hash; the file need not exist."""
    return settings().files_dir.joinpath(sha256[:2], sha256)


@contextmanager
def incoming() -> Iterator[Path]:
    """Give a path on the store's own disk for an arriving file.

    The file is removed at the end unless it was kept.
    """
    handle, name = tempfile.mkstemp(dir=made_incoming_folder())
    path = Path(name)
    try:
        # The lock ends with this process, so that a clean-up recognises the files of a process that was killed.
        fcntl.flock(handle, fcntl.LOCK_SH)
        yield path
    finally:
        path.unlink(missing_ok=True)
        os.close(handle)


@contextmanager
def incoming_files() -> Iterator[Path]:
    """Give a folder on the store's own disk for arriving files.

    The folder is removed at the end with the files that were not moved.
    """
    folder = Path(tempfile.mkdtemp(dir=made_incoming_folder()))
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_SH)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(handle)


def incoming_folder() -> Path:
    """Return the folder of the files that have not arrived whole."""
    return settings().files_dir / "incoming"


def made_incoming_folder() -> Path:
    """Return :func:`incoming_folder`; make it where there is none."""
    folder = incoming_folder()
    make_private_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    return folder


def remove_abandoned() -> int:
    """Remove the incoming files and folders of dead processes.

    Return how many.
    """
    removed = 0
    for path in incoming_folder().glob("*"):
        with suppress(OSError):
            handle = os.open(path, os.O_RDONLY)
            try:
                if time.time() - os.fstat(handle).st_mtime < ABANDONED_SECONDS:
                    continue
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()
                removed += 1
            finally:
                os.close(handle)
    return removed


def sha256_of(path: Path) -> str:
    """Return the hash of a file's content."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def is_whole(sha256: str) -> bool:
    """Return whether a file exists and its content has the hash of its address.

    A process reads a file again only when the file has changed since it last did so, or since any process stored a long file within
    the last hour.
    """
    path = path_of(sha256)
    try:
        state = _state_of(path)
        if _is_checked(sha256, state):
            return True
        if sha256_of(path) != sha256:
            return False
    except FileNotFoundError:
        return False
    _remember_check(sha256, state)
    return True


def _state_of(path: Path) -> tuple[int, ...]:
    """Return the state of a file, which changes with its content.

    It is the inode, the size, and the times of the last changes.
    """
    facts = path.stat()
    return facts.st_ino, facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns


def _is_checked(sha256: str, state: tuple[int, ...]) -> bool:
    """Return whether the content of the file in this state is known.

    This process has checked it, or any process has stored and flushed the long file in this state a short time ago.
    """
    with _checked_lock:
        if _checked.get(sha256) == state:
            _checked.move_to_end(sha256)
            return True
    *_, size, _, changed_ns = state
    if size < _LONG_BYTES or time.time_ns() - changed_ns > _RECENT_NS:
        return False
    with reading() as session:
        stored = session.scalar(_STATE, {"sha256": sha256})
    if stored != list(state):
        return False
    _remember_check(sha256, state)
    return True


def _remember_check(sha256: str, state: tuple[int, ...]) -> None:
    with _checked_lock:
        _checked[sha256] = state
        while len(_checked) > _REMEMBERED_CHECKS:
            _checked.popitem(last=False)


def checked_path(sha256: str) -> Path:
    """Return the path of a stored file whose content has been checked.

    Raises
    ------
    BrokenFile
        When the file is missing or its content has another hash.
    """
    if not is_whole(sha256):
        raise BrokenFile(sha256)
    return path_of(sha256)


@contextmanager
def checked_meanwhile(sha256: str) -> Iterator[Path]:
    """Check a stored file while the caller reads it.

    For a caller that reads a small part of a long file, and that no content can harm: a decoder needs :func:`checked_path`.

    Raises
    ------
    BrokenFile
        At the end, when the file is missing or its content has another hash; whatever the caller raised.
    """
    with ThreadPoolExecutor(1) as checker:
        whole = checker.submit(is_whole, sha256)
        try:
            yield path_of(sha256)
        except Exception:
            if not whole.result():
                raise BrokenFile(sha256) from None
            raise
    if not whole.result():
        raise BrokenFile(sha256)


def read(sha256: str) -> bytes:
    """Return the content of a stored file after a check of its hash.

    A process checks a file again only when the file has changed since it last did so.

    Raises
    ------
    BrokenFile
        When the file is missing or its content has another hash.
    """
    path = path_of(sha256)
    try:
        state = _state_of(path)
        content = path.read_bytes()
    except FileNotFoundError:
        raise BrokenFile(sha256) from None
    if not _is_checked(sha256, state):
        if hashlib.sha256(content).hexdigest() != sha256:
            raise BrokenFile(sha256)
        _remember_check(sha256, state)
    return content


def lock(session: Session) -> None:
    """Keep other transactions from adding and removing files until this one ends.

    SQLite has only one writer at a time, so it needs no lock.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _FILES_LOCK})


def keep(session: Session, path: Path, *, sha256: str | None = None, durable: bool = True) -> str:
    """Move an incoming file to its content address; return its hash.

    The file's row is added. A file that is already there is replaced, because it may be damaged.

    Parameters
    ----------
    session : Session
    path : Path
    sha256 : str, optional
        Hash of the content. With it the transaction does not read a long file again.
    durable : bool
        Whether to flush the file to disk. Without it a crash of the machine may damage the file, so only what can be made again
        needs no flush.
    """
    sha256 = sha256 or sha256_of(path)
    lock(session)
    target = path_of(sha256)
    target.parent.mkdir(parents=True, exist_ok=True)
    if durable:
        _flush(path)
    path.replace(target)
    if durable:
        _flush(target.parent)
    # This process has just read or written the whole content.
    state = _state_of(target)
    _remember_check(sha256, state)
    session.merge(File(sha256=sha256, state=list(state) if durable else None))
    session.flush()
    return sha256


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


_STATE = select(File.state).where(File.sha256 == bindparam("sha256"))


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
