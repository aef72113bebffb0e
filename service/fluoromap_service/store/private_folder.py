"""The data folder: only the user of the service may read it, because it holds patient data."""

from __future__ import annotations

import os
from pathlib import Path

FOLDER_MODE = 0o700
FILE_MODE = 0o600


def make_private_folder(folder: Path) -> None:
    """Make a folder that other users cannot enter.

    An existing folder is closed to them too. A folder of another owner stays, because its owner decides: a volume of a
    container platform, for example.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=FOLDER_MODE)
    _take_away(folder, FOLDER_MODE)


def make_private_file(path: Path) -> None:
    """Make an empty file that other users cannot read.

    An existing file is closed to them.
    """
    os.close(os.open(path, os.O_CREAT | os.O_RDWR, FILE_MODE))
    _take_away(path, FILE_MODE)


def _take_away(path: Path, mode: int) -> None:
    facts = path.stat()
    if facts.st_uid == os.geteuid() and facts.st_mode & 0o077:
        path.chmod(mode)
