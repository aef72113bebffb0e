"""Free space on the disk of the files, and the reserve that uploads leave to running jobs."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from fluoromap_service.settings import settings

FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Error numbers of the operating system that say that the disk is full."""


class NoSpace(OSError):
    """The disk is full, or nearly so."""

    def __init__(self) -> None:
        super().__init__(errno.ENOSPC, os.strerror(errno.ENOSPC))


def free_bytes() -> int:
    """Return the space that this user may still fill."""
    facts = os.statvfs(_existing(settings().data_dir))
    return facts.f_bavail * facts.f_frsize


def total_bytes() -> int:
    """Return the size of the disk of the data folder."""
    facts = os.statvfs(_existing(settings().data_dir))
    return facts.f_blocks * facts.f_frsize


def reserve_bytes() -> int:
    """Return the space that requests may not fill."""
    return settings().min_free_mib * 2**20


def check_room(wanted_bytes: int = 0) -> None:
    """Check that the disk has room for more bytes and keeps its reserve.

    Raises
    ------
    NoSpace
        When it has not.
    """
    if free_bytes() - wanted_bytes < reserve_bytes():
        raise NoSpace


def _existing(path: Path) -> Path:
    return path if path.exists() else _existing(path.absolute().parent)
