"""The displacement of the table, and of the patient on it, between the runs of a study."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime

from fluoromap_service.dicom.facts import InstanceFacts, Point, TableOrigin

_LAST = datetime.max.replace(tzinfo=UTC)


def table_offsets_mm(runs: Iterable[InstanceFacts]) -> dict[str, Point]:
    """Return the displacement of the table since the first run.

    Keys are SOP Instance UIDs. Displacements are in millimetres along the patient's axes (LPS). The first run is the earliest
    by acquisition time. Positions that different attributes state have different origins, so that each origin has a first run
    of its own. A run without a known position is left out.
    """
    first: dict[TableOrigin, Point] = {}
    offsets: dict[str, Point] = {}
    for run in sorted(runs, key=lambda run: (run.acquired or _LAST, run.sop_instance_uid)):
        if run.table_mm is None or run.table_origin is None:
            continue
        x, y, z = run.table_mm
        x0, y0, z0 = first.setdefault(run.table_origin, run.table_mm)
        offsets[run.sop_instance_uid] = (x - x0, y - y0, z - z0)
    return offsets
