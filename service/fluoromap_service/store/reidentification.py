"""The secret of de-identified exports, and the lists that lead back from their UIDs. They stay in a private folder.

``<data folder>/reidentification/secret`` holds 32 random bytes. ``<study id>.csv`` beside it lists each replaced identifier of the
study's exports, and goes with the study. Neither is part of an export or of a backup.
"""

from __future__ import annotations

import csv
import fcntl
import os
import secrets
from collections.abc import Mapping
from pathlib import Path

from fluoromap_service.settings import settings
from fluoromap_service.store.private_folder import make_private_file, make_private_folder

SECRET_BYTES = 32


def folder() -> Path:
    """Return the private folder."""
    return settings().data_dir / "reidentification"


def secret() -> bytes:
    """Return the secret of this installation; the first call makes it."""
    make_private_folder(folder())
    path = folder() / "secret"
    make_private_file(path)
    with path.open("r+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        content = file.read()
        if len(content) != SECRET_BYTES:
            content = secrets.token_bytes(SECRET_BYTES)
            file.seek(0)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    return content


def table_of(study_id: str) -> Path:
    """Return the path of a study's list, which need not exist."""
    return folder() / f"{study_id}.csv"


def studies_with_table() -> set[str]:
    """Return the ids of the studies that have a list."""
    return {path.stem for path in folder().glob("*.csv")}


def remove_table(study_id: str) -> None:
    """Remove the list of a deleted study."""
    table_of(study_id).unlink(missing_ok=True)


def add_replacements(study_id: str, replaced: Mapping[str, str]) -> Path:
    """Add original identifiers and their replacements to the list of a study.

    Returns
    -------
    Path
        The list: a CSV file with the columns ``original`` and ``replacement``.
    """
    make_private_folder(folder())
    path = table_of(study_id)
    make_private_file(path)
    with path.open("r+", newline="") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        known = {tuple(row) for row in csv.reader(file)}
        rows = [("original", "replacement"), *sorted(replaced.items())]
        csv.writer(file).writerows(row for row in rows if row not in known)
    return path
