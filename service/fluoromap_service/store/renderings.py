"""Kept renderings: pictures, meshes, tables and pages that the service makes of a job's results once.

The jobs of a study share them: a rendering is kept under the hash of the study and of everything that changes it. So a job whose
map did not change has the pictures of the job before it. A rendering is deleted with the job that it was made for, and when all
together take more than their space and it is the longest unused. A request that needs it makes it again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from sqlalchemy import func, select, update
from sqlalchemy.exc import IntegrityError

from fluoromap_service.store import disk, files
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Job, Rendering

USED_SECONDS = 3600.0
"""Time within which another use of a rendering is not noted, so that few reads write."""


@dataclass(frozen=True, slots=True)
class KeptFile:
    """The file of a kept rendering, and the hash of its content."""

    sha256: str
    path: Path


def kept_rendering(job_id: str, depends_on: dict[str, Any], make: Callable[[], bytes]) -> KeptFile:
    """Return a kept rendering; make it when there is none.

    Parameters
    ----------
    job_id : str
        The job that needs it.
    depends_on : dict
        JSON values: everything that changes the rendering.
    make : callable
        Makes the content. It is called outside any transaction.
    """
    return kept_file(job_id, depends_on, lambda file: file.write(make()))


def kept_file(job_id: str, depends_on: dict[str, Any], write: Callable[[IO[bytes]], object]) -> KeptFile:
    """Return a kept rendering; write it when there is none.

    For long ones, which are never whole in memory.

    Parameters
    ----------
    job_id : str
    depends_on : dict
        As :func:`kept_rendering`.
    write : callable
        Writes the content into an open file, piece by piece. It is called outside any transaction.

    Raises
    ------
    NoSpace
        When only the reserve of the disk is left. A kept one is returned nevertheless.
    """
    key = _key(job_id, depends_on)
    kept = _find(key)
    if kept is not None:
        return kept
    disk.check_room()
    with files.incoming() as path:
        with path.open("wb") as file:
            write(file)
        disk.check_room()
        size = path.stat().st_size
        # Other writers wait for the transaction, so the hash of a long file is made before it.
        sha256 = files.sha256_of(path)
        try:
            with writing() as session:
                files.keep(session, path, sha256=sha256, durable=False)
                row = session.scalar(select(Rendering).where(Rendering.key == key))
                if row is None:
                    session.add(Rendering(job_id=job_id, key=key, sha256=sha256, bytes=size))
                else:
                    row.sha256, row.bytes = sha256, size
        except IntegrityError:
            # Another request made the same rendering meanwhile: take that one.
            kept = _find(key)
            if kept is None:
                raise
            return kept
    return KeptFile(sha256, files.path_of(sha256))


def find_rendering(job_id: str, depends_on: dict[str, Any]) -> KeptFile | None:
    """Return the kept rendering of a job; None when there is none."""
    return _find(_key(job_id, depends_on))


def _key(job_id: str, depends_on: dict[str, Any]) -> str:
    with reading() as session:
        study = session.scalar(select(Job.study_id).where(Job.id == job_id))
    return hashlib.sha256(json.dumps([study, depends_on], sort_keys=True).encode()).hexdigest()


def _find(key: str) -> KeptFile | None:
    unused = func.coalesce(Rendering.used, 0.0) < db_now() - USED_SECONDS
    with reading() as session:
        row = session.execute(select(Rendering.sha256, unused).where(Rendering.key == key)).first()
    if row is None or not files.is_whole(row[0]):
        return None
    if row[1]:
        with writing() as session:
            session.execute(update(Rendering).where(Rendering.key == key).values(used=db_now()))
    return KeptFile(row[0], files.path_of(row[0]))
