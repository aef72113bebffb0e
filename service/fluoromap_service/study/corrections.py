"""Electrodes set by hand, in versions; the newest version of a frame counts."""

from __future__ import annotations

from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from fluoromap_service.store.models import Correction
from fluoromap_service.study.snapshot import CorrectedElectrode


def newest(session: Session, study_id: str, uid: str, frame: int) -> Correction | None:
    """Return the newest version of a frame (counted from 1).

    Its ``electrodes`` may be null: the return to automatic detection.
    """
    return session.scalar(
        select(Correction)
        .where(Correction.study_id == study_id, Correction.sop_instance_uid == uid, Correction.frame == frame)
        .order_by(Correction.version.desc())
        .limit(1)
    )


def put(
    session: Session,
    study_id: str,
    uid: str,
    frame: int,
    electrodes: tuple[CorrectedElectrode, ...] | None,
    author: str,
) -> Correction:
    """Add a version of the frame's electrodes; None returns the frame to automatic detection."""
    last = session.scalar(
        select(func.max(Correction.version)).where(
            Correction.study_id == study_id, Correction.sop_instance_uid == uid, Correction.frame == frame
        )
    )
    correction = Correction(
        study_id=study_id,
        sop_instance_uid=uid,
        frame=frame,
        version=(last or 0) + 1,
        electrodes=None if electrodes is None else [electrode.model_dump() for electrode in electrodes],
        author=author,
    )
    session.add(correction)
    session.flush()
    return correction


def of_study(session: Session, study_id: str) -> dict[str, dict[int, tuple[CorrectedElectrode, ...]]]:
    """Return all electrodes set by hand: SOP Instance UID -> frame (from 1) -> electrodes."""
    newest_rows: dict[tuple[str, int], list[Any] | None] = {}
    for correction in session.scalars(
        select(Correction).where(Correction.study_id == study_id).order_by(Correction.version)
    ):
        newest_rows[correction.sop_instance_uid, correction.frame] = correction.electrodes
    found: dict[str, dict[int, tuple[CorrectedElectrode, ...]]] = {}
    for (uid, frame), electrodes in sorted(newest_rows.items()):
        if electrodes is not None:
            found.setdefault(uid, {})[frame] = tuple(CorrectedElectrode(**electrode) for electrode in electrodes)
    return found
