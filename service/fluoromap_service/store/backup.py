"""A backup of the embedded store, SQLite and files, in one tar archive; and the way back.

The archive has ``fluoromap.sqlite``, a consistent copy of the database, and each stored file as ``files/<hash>``.
"""

from __future__ import annotations

import hashlib
import os
import re
import sqlite3
import tarfile
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from alembic.script import ScriptDirectory
from sqlalchemy import make_url, select

from fluoromap_service.settings import settings
from fluoromap_service.store import audit, files, schema
from fluoromap_service.store.audit import Act
from fluoromap_service.store.engine import forget_engine, writing
from fluoromap_service.store.models import File
from fluoromap_service.store.private_folder import FILE_MODE, make_private_folder

DATABASE = "fluoromap.sqlite"
_FILE = re.compile(r"files/([0-9a-f]{64})")


class BackupFailed(Exception):
    """A backup that cannot be made or restored; the message says what to do."""


@dataclass(frozen=True, slots=True)
class BackedUp:
    """The content of a backup.

    Parameters
    ----------
    files : int
        Number of files in it.
    broken : tuple of str
        Hashes of the files that are missing or damaged in the store, and therefore in the backup.
    """

    files: int
    broken: tuple[str, ...]


def backup(target: Path) -> BackedUp:
    """Write a backup while the service runs.

    Raises
    ------
    BackupFailed
        When the database is not SQLite.
    OSError
        When the archive cannot be written.
    """
    database = _sqlite_path()
    part = target.with_name(f"{target.name}.part")
    with files.incoming_files() as folder:
        broken = _take_snapshot(database, folder)
        names = sorted(path.name for path in folder.iterdir() if path.name != DATABASE)
        try:
            with open(part, "wb", opener=_private) as stream, tarfile.open(fileobj=stream, mode="w") as archive:
                archive.add(folder / DATABASE, DATABASE)
                for name in names:
                    if files.sha256_of(folder / name) == name:
                        archive.add(folder / name, f"files/{name}")
                    else:
                        broken.append(name)
                archive.close()
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    return BackedUp(len(names) - sum(name in broken for name in names), tuple(sorted(broken)))


def restore(source: Path) -> BackedUp:
    """Bring a backup into an empty data folder and migrate it to this version.

    The database comes last, so that an interrupted restore leaves no service that lacks files.

    Raises
    ------
    BackupFailed
        When the data folder has a database or its log already, or the archive is damaged or newer than this version.
    """
    database = _sqlite_path()
    # SQLite would write a write-ahead log that is left from another database into the restored one.
    for path in (
        database,
        *(database.with_name(f"{database.name}{suffix}") for suffix in ("-wal", "-shm", "-journal")),
    ):
        if path.exists():
            raise BackupFailed(f"{path} exists. Restore into an empty folder: give another one with --data-dir.")
    make_private_folder(settings().data_dir)
    count = 0
    with files.incoming_files() as folder:
        try:
            with tarfile.open(source, "r:") as archive:
                for member in archive:
                    content = archive.extractfile(member)
                    match = _FILE.fullmatch(member.name)
                    if content is None or not (match or member.name == DATABASE):
                        raise BackupFailed(f"{source} is no backup of fluoromap: it holds {member.name!r}.")
                    copy = folder / DATABASE if match is None else folder / match[1]
                    sha256 = _copy(content, copy)
                    if match is not None:
                        if sha256 != match[1]:
                            raise BackupFailed(f"{source} is damaged: the file {match[1]} has other content.")
                        place = files.path_of(sha256)
                        place.parent.mkdir(parents=True, exist_ok=True)
                        copy.replace(place)
                        count += 1
        except tarfile.TarError as error:
            raise BackupFailed(f"{source} is damaged or no backup of fluoromap ({error}).") from error
        _check_database(folder / DATABASE, source)
        (folder / DATABASE).replace(database)
    forget_engine()
    schema.upgrade()
    with writing() as session:
        audit.append(session, [Act("command line", "restore")])
        missing = [sha256 for sha256 in session.scalars(select(File.sha256)) if not files.path_of(sha256).exists()]
    return BackedUp(count, tuple(missing))


def _sqlite_path() -> Path:
    url = make_url(settings().effective_database_url)
    if url.get_backend_name() != "sqlite" or not url.database:
        raise BackupFailed(
            "This command serves SQLite. For PostgreSQL use pg_dump and copy the folder of the files, as docs/operations.md shows."
        )
    return Path(url.database)


def _take_snapshot(database: Path, folder: Path) -> list[str]:
    """Link all files and copy the database, both of one moment.

    Return the hashes of missing files.
    """
    missing = []
    with closing(sqlite3.connect(database)) as live, closing(sqlite3.connect(folder / DATABASE)) as copy:
        # Nobody can delete a file or commit a row until this transaction ends.
        with writing() as session:
            for sha256 in session.scalars(select(File.sha256)):
                try:
                    os.link(files.path_of(sha256), folder / sha256)
                except FileNotFoundError:
                    missing.append(sha256)
            # A transaction reads the database of its first statement: the service may write during the copy.
            live.execute("BEGIN")
            live.execute("SELECT count(*) FROM alembic_version")
        live.backup(copy)
    with writing() as session:
        audit.append(session, [Act("command line", "backup")])
    return missing


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, FILE_MODE)


def _copy(content: IO[bytes], target: Path) -> str:
    digest = hashlib.sha256()
    with open(target, "wb", opener=_private) as stream:
        while chunk := content.read(files.CHUNK_BYTES):
            stream.write(chunk)
            digest.update(chunk)
        stream.flush()
        os.fsync(stream.fileno())
    return digest.hexdigest()


def _check_database(path: Path, source: Path) -> None:
    if not path.exists():
        raise BackupFailed(f"{source} is damaged: it holds no database.")
    try:
        with closing(sqlite3.connect(path)) as connection:
            state = connection.execute("PRAGMA integrity_check").fetchone()[0]
            version = connection.execute("SELECT version_num FROM alembic_version").fetchone()[0]
    except sqlite3.DatabaseError as error:
        raise BackupFailed(f"{source} is damaged: its database cannot be read ({error}).") from error
    if state != "ok":
        raise BackupFailed(f"{source} is damaged: its database is inconsistent.")
    known = {script.revision for script in ScriptDirectory.from_config(schema.configuration()).walk_revisions()}
    if version not in known:
        raise BackupFailed(f"{source} comes from a newer version of fluoromap; install that version first.")
