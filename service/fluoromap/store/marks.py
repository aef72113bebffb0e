"""Electrodes set by hand, version by version; the newest version of a frame counts."""

from __future__ import annotations

from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from fluoromap.store.manifest import MarkPlan
from fluoromap.store.models import Mark


def newest(session: Session, study_id: str, uid: str, frame: int) -> Mark | None:
    """The frame's newest version, which may be the return to automatic (``electrodes`` null); frames count from 1."""
    return session.scalar(
        select(Mark)
        .where(Mark.study_id == study_id, Mark.sop_instance_uid == uid, Mark.frame == frame)
        .order_by(Mark.version.desc())
        .limit(1)
    )


def put(
    session: Session, study_id: str, uid: str, frame: int, electrodes: tuple[MarkPlan, ...] | None, author: str
) -> Mark:
    """Add a version of the frame's electrodes; None returns the frame to automatic detection."""
    last = session.scalar(
        select(func.max(Mark.version)).where(
            Mark.study_id == study_id, Mark.sop_instance_uid == uid, Mark.frame == frame
        )
    )
    mark = Mark(
        study_id=study_id,
        sop_instance_uid=uid,
        frame=frame,
        version=(last or 0) + 1,
        electrodes=None if electrodes is None else [electrode.model_dump() for electrode in electrodes],
        author=author,
    )
    session.add(mark)
    session.flush()
    return mark


def of_study(session: Session, study_id: str) -> dict[str, dict[int, tuple[MarkPlan, ...]]]:
    """All frames of a study set by hand: SOP Instance UID -> frame (from 1) -> electrodes."""
    newest_rows: dict[tuple[str, int], list[Any] | None] = {}
    for mark in session.scalars(select(Mark).where(Mark.study_id == study_id).order_by(Mark.version)):
        newest_rows[mark.sop_instance_uid, mark.frame] = mark.electrodes
    found: dict[str, dict[int, tuple[MarkPlan, ...]]] = {}
    for (uid, frame), electrodes in sorted(newest_rows.items()):
        if electrodes is not None:
            found.setdefault(uid, {})[frame] = tuple(MarkPlan(**electrode) for electrode in electrodes)
    return found
