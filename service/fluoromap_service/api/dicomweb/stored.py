"""The stored instances as DICOMweb shows them: their place in study and series, and their headers."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import select

from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.dicom import InstanceFacts
from fluoromap_service.dicom.json_model import header_json
from fluoromap_service.problem import not_found
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Instance

Json = dict[str, Any]

_REMEMBERED_HEADERS = 2000
_headers: OrderedDict[str, Json] = OrderedDict()
_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class StoredInstance:
    """One stored instance."""

    study_uid: str
    series_uid: str
    uid: str
    sha256: str
    facts: InstanceFacts

    @property
    def path(self) -> Path:
        """Path of the file, after a check of its hash."""
        return files.checked_path(self.sha256)

    @property
    def header(self) -> Json:
        """The header in the DICOM JSON model; the content of a file never changes, so it is read once."""
        with _lock:
            if self.sha256 in _headers:
                _headers.move_to_end(self.sha256)
                return _headers[self.sha256]
        # A hostile header can take any time, so another process reads it.
        header = run_in_pool(Task.READ_FILE, header_json, self.path)
        with _lock:
            _headers[self.sha256] = header
            while len(_headers) > _REMEMBERED_HEADERS:
                _headers.popitem(last=False)
        return header


def instances_of(
    study_uid: str | None = None, series_uid: str | None = None, uid: str | None = None
) -> list[StoredInstance]:
    """Return the stored instances in the order of their UIDs.

    Each argument limits them to a DICOM study, to a series, or to one UID.
    """
    query = select(Instance).order_by(
        Instance.study_instance_uid, Instance.series_instance_uid, Instance.sop_instance_uid
    )
    if study_uid is not None:
        query = query.where(Instance.study_instance_uid == study_uid)
    if series_uid is not None:
        query = query.where(Instance.series_instance_uid == series_uid)
    if uid is not None:
        query = query.where(Instance.sop_instance_uid == uid)
    with reading() as session:
        return [
            StoredInstance(
                row.study_instance_uid,
                row.series_instance_uid,
                row.sop_instance_uid,
                row.sha256,
                InstanceFacts.from_json(row.facts),
            )
            for row in session.scalars(query)
        ]


def existing(study_uid: str, series_uid: str | None = None, uid: str | None = None) -> list[StoredInstance]:
    """Return the stored instances of a resource.

    Raises
    ------
    Problem
        404 when there is none.
    """
    found = instances_of(study_uid, series_uid, uid)
    if not found:
        raise not_found("DICOM study, series or instance")
    return found
