"""The file of a stored run, checked before or while somebody reads it."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from sqlalchemy import select

from fluoromap_service.dicom.facts import InstanceFacts
from fluoromap_service.dicom.pixel_layout import NATIVE
from fluoromap_service.problem import Problem
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Instance


def checked_run(sha256: str, facts: InstanceFacts) -> AbstractContextManager[Path]:
    """Give the path of a stored run whose content is checked.

    A picture or a correction reads few frames, and the check of a long file takes as long as their work. So an uncompressed file
    is checked meanwhile. A compressed file is checked before, because damage can crash its decoder.

    Raises
    ------
    BrokenFile
        At the start or at the end, when the file is missing or its content has another hash.
    """
    if facts.transfer_syntax in NATIVE:
        return files.checked_meanwhile(sha256)
    return nullcontext(files.checked_path(sha256))


def check_not_deleted(hashes: Iterable[str]) -> None:
    """Check that the runs with these files still exist.

    A job outlives the runs that somebody deletes. A file that is missing although its run exists is damage: the reader reports it.

    Raises
    ------
    Problem
        409 ``run_deleted``.
    """
    wanted = set(hashes)
    with reading() as session:
        known = set(session.scalars(select(Instance.sha256).where(Instance.sha256.in_(wanted))))
    if known != wanted:
        raise Problem(409, "run_deleted", "Somebody deleted a run of this job; upload it again and start a new job.")
