"""The file of a stored run, checked before or while somebody reads it."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from fluoromap_service.dicom.facts import InstanceFacts
from fluoromap_service.dicom.pixel_layout import NATIVE
from fluoromap_service.store import files


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
