"""Pictures and meshes made of a job's results on request, made once and kept."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError

from fluoromap_service.store import files
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Rendering


@dataclass(frozen=True, slots=True)
class Rendered:
    """A kept rendering: its hash, and the file that holds it."""

    sha256: str
    path: Path


def rendered(job_id: str, asked: dict[str, Any], media_type: str, make: Callable[[], bytes]) -> Rendered:
    """The kept rendering of a job for everything that was asked for, made by ``make`` when there is none yet.

    Parameters
    ----------
    job_id : str
    asked : dict
        JSON values; whatever changes the picture must be in it.
    media_type : str
    make : callable
        Called outside any transaction.
    """
    key = hashlib.sha256(json.dumps([job_id, _version(), asked], sort_keys=True).encode()).hexdigest()
    kept = _kept(key)
    if kept is not None:
        return kept
    content = make()
    try:
        with writing() as session:
            sha256 = files.keep_bytes(session, content, media_type)
            row = session.scalar(select(Rendering).where(Rendering.key == key))
            if row is None:
                session.add(Rendering(job_id=job_id, key=key, sha256=sha256))
            else:
                row.sha256 = sha256
    except IntegrityError:
        # Someone else made the same picture meanwhile; theirs is as good.
        kept = _kept(key)
        if kept is None:
            raise
        return kept
    return Rendered(sha256, files.path_of(sha256))


def _kept(key: str) -> Rendered | None:
    with reading() as session:
        sha256 = session.scalar(select(Rendering.sha256).where(Rendering.key == key))
    if sha256 is None or not files.path_of(sha256).exists():
        return None
    return Rendered(sha256, files.path_of(sha256))


@functools.cache
def _version() -> str:
    return version("fluoromap")
