"""The order in which ready stages get their turn: which are announced, and which one a worker takes next."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, case, func, or_, select, update
from sqlalchemy.orm import Session

from fluoromap_service.jobs.pipeline import PIPELINE
from fluoromap_service.settings import settings
from fluoromap_service.store.clock import CLOCK_TOLERANCE_SECONDS, db_now
from fluoromap_service.store.models import ENDED_STAGE, Job, JobState, StageRow, StageState

LONGEST_REPUBLISH_SECONDS = 60.0
ANNOUNCED_AT_ONCE = 8
"""Most announcements after one request or stage. Each of them wakes a worker, which then takes stages until none is ready."""
AGE_OF_A_STAGE_SECONDS = 5.0
"""Age of a job that counts as one stage less when workers choose the next stage."""


@dataclass(frozen=True, slots=True)
class ReadyStage:
    """A stage that a worker may claim."""

    stage_id: int
    job_id: str
    name: str


def take_due(session: Session, limit: int = ANNOUNCED_AT_ONCE) -> list[int]:
    """Return the ready stages that need an announcement, and note that they are announced.

    These are stages that were never announced, and stages whose announcement is so old that it may be lost. A worker that hears
    of one takes stages until none is ready, so few announcements at once are enough.
    """
    wait = settings().republish_seconds
    # Each repetition waits longer, so that a long queue is not announced over and over.
    due = or_(
        StageRow.published.is_(None),
        StageRow.published < db_now() - StageRow.publications * wait,
        StageRow.published < db_now() - LONGEST_REPUBLISH_SECONDS,
        # Somebody has set the clock back.
        StageRow.published > db_now() + CLOCK_TOLERANCE_SECONDS,
    )
    query = select(StageRow.id).where(StageRow.state == StageState.READY, due).order_by(StageRow.id).limit(limit)
    ids = list(session.scalars(query.with_for_update(skip_locked=True)))
    if ids:
        session.execute(
            update(StageRow)
            .where(StageRow.id.in_(ids))
            .values(published=db_now(), publications=StageRow.publications + 1)
        )
    return ids


def most_urgent(session: Session) -> ReadyStage | None:
    """Return the stage that a worker should take next.

    None when no stage is ready. The order:

    1. Stages about a whole study come first: they are short, and the map waits for them.
    2. Then come jobs of which no stage has begun, the oldest first: a worker must see how much of them is known.
    3. Then comes the job with the fewest stages left. So a small job or a correction does not wait for a large study. Each
       ``AGE_OF_A_STAGE_SECONDS`` of age count as one stage less, so that no job waits for ever.
    4. The stages of one job come in the order of the pipeline.
    """
    found = session.execute(_most_urgent()).first()
    return None if found is None else ReadyStage(*found)


@functools.cache
def _most_urgent() -> Select[*tuple[Any, ...]]:
    """Return the query, built once: workers ask it between any two stages."""
    whole_study = [stage.name for stage in PIPELINE if stage.subject == "study"]
    open_states = [state for state in StageState if state not in ENDED_STAGE]
    left = (
        select(StageRow.job_id, func.count().label("stages"))
        .where(StageRow.state.in_(open_states))
        .group_by(StageRow.job_id)
        .subquery()
    )
    is_new = Job.state == JobState.QUEUED
    return (
        select(StageRow.id, StageRow.job_id, StageRow.name)
        .join(Job, Job.id == StageRow.job_id)
        .join(left, left.c.job_id == StageRow.job_id)
        .where(StageRow.state == StageState.READY)
        .order_by(
            case((StageRow.name.in_(whole_study), 0), (is_new, 1), else_=2),
            case((is_new, 0.0), else_=left.c.stages) + Job.created / AGE_OF_A_STAGE_SECONDS,
            Job.id,
            StageRow.id,
        )
        .limit(1)
    )
