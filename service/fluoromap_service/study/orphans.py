"""Files that nothing in the database refers to: left when a process ended between a commit and the removal of its files."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import structlog
from sqlalchemy import select

from fluoromap_service.settings import settings
from fluoromap_service.store import reidentification
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import File, Study
from fluoromap_service.study.instances import unlink_unreferenced

SETTLED_SECONDS = 1800.0
"""Age from which a file without a row is an orphan; a younger one may belong to a transaction that has not ended."""

log = structlog.get_logger(__name__)


def orphans(settled_seconds: float = SETTLED_SECONDS) -> Iterator[str]:
    """Yield the hashes of the stored files without a row.

    It compares folder by folder, so that it holds neither all names nor all rows in memory.
    """
    now = time.time()
    for folder in sorted(settings().files_dir.glob("[0-9a-f][0-9a-f]")):
        names = sorted(path.name for path in folder.iterdir() if re.fullmatch(r"[0-9a-f]{64}", path.name))
        # The rows after the names: a file that arrives in between is not among the names.
        with reading() as session:
            rows = set(session.scalars(select(File.sha256).where(File.sha256.startswith(folder.name))))
        for name in names:
            try:
                if name not in rows and now - (folder / name).stat().st_ctime >= settled_seconds:
                    yield name
            except FileNotFoundError:
                # Its study was deleted meanwhile.
                continue


def remove_orphans(settled_seconds: float = SETTLED_SECONDS) -> int:
    """Remove the files without a row, and tables of deleted studies.

    These tables lead back from de-identified exports. Any process may call it at any time: each file is removed under the lock of
    the files, after another look at its row. Return how many files and tables went.
    """
    found = list(orphans(settled_seconds))
    if found:
        unlink_unreferenced(found)
    tables = reidentification.studies_with_table()
    # The studies after the tables, so that a new study with its first table is among them.
    with reading() as session:
        deleted = tables - set(session.scalars(select(Study.id)))
    for study_id in deleted:
        reidentification.remove_table(study_id)
    if found or deleted:
        log.info("orphans_removed", files=len(found), tables=len(deleted))
    return len(found) + len(deleted)
