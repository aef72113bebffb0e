"""The outbox of deliveries. SQL is the truth, and its times are the database's.

A committed row in state ``pending`` may be claimed. A claim lasts as long as its lease is extended, and each attempt has a
number: a sender that lost its claim changes nothing. An object is marked as ``sending`` before its first byte leaves. After a
crash the next sender therefore knows which object the target may have already, and asks the target.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import and_, exists, or_, select, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session, defer

from fluoromap_service.deliveries.targets import Target
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.settings import settings
from fluoromap_service.store import audit, tally
from fluoromap_service.store.audit import Act
from fluoromap_service.store.clock import CLOCK_TOLERANCE_SECONDS, db_now
from fluoromap_service.store.models import (
    ENDED_JOB,
    Delivery,
    DeliveryAttempt,
    DeliveryObject,
    DeliveryState,
    DeliveryTarget,
    Job,
    ObjectState,
)

OVERLAP_SECONDS = 600.0
"""A transaction that ends a job commits at most this long after the time that it stores as the job's end."""
DAY_SECONDS = 86400.0


@dataclass(frozen=True, slots=True)
class Claim:
    """The right to send a delivery, until its lease ends."""

    delivery_id: str
    job_id: str
    target: str
    attempt: int


@dataclass(frozen=True, slots=True)
class Failure:
    """The reason why an attempt failed: a stable code, and a sentence without text from the target."""

    code: str
    detail: str


_LOST = Failure("sender_lost", "The sender ended in the middle of this attempt; another attempt follows by itself.")


def register(session: Session, targets: Iterable[Target]) -> None:
    """Add the targets that are new.

    Jobs that end from now on are delivered to them.
    """
    insert = postgresql.insert if session.get_bind().dialect.name == "postgresql" else sqlite.insert
    for target in sorted(targets, key=lambda target: target.name):
        row = insert(DeliveryTarget).values(name=target.name, kind=target.kind, since=db_now())
        session.execute(row.on_conflict_do_update(index_elements=["name"], set_={"kind": target.kind}))


def needs_work(session: Session, target: str, job_ends: Iterable[str]) -> bool:
    """Return whether :func:`plan`, :func:`reap` or :func:`claim` would find something; it only reads."""
    open_rows = select(Delivery.id).where(Delivery.target == target, or_(_due(), _expired()))
    return bool(
        session.scalar(select(exists(open_rows))) or session.scalar(select(exists(_unplanned(target, job_ends))))
    )


def plan(session: Session, target: str, job_ends: Iterable[str]) -> int:
    """Add the deliveries that are missing, and return how many.

    Each job that ended since the target was registered needs one.
    """
    _lock_target(session, target)
    jobs = session.scalars(_unplanned(target, job_ends)).all()
    for job_id in jobs:
        _add(session, target, job_id)
    now = session.scalar(select(db_now())) or 0.0
    seen_until = now - OVERLAP_SECONDS
    session.execute(
        update(DeliveryTarget)
        .where(DeliveryTarget.name == target, DeliveryTarget.since < seen_until)
        .values(since=seen_until)
    )
    return len(jobs)


def _lock_target(session: Session, target: str) -> None:
    """Let no other transaction add deliveries to a target until this one ends."""
    session.execute(select(DeliveryTarget.name).where(DeliveryTarget.name == target).with_for_update())


def _unplanned(target: str, job_ends: Iterable[str]) -> Any:
    known = exists().where(Delivery.job_id == Job.id, Delivery.target == target)
    since = select(DeliveryTarget.since).where(DeliveryTarget.name == target).scalar_subquery()
    return select(Job.id).where(Job.finished >= since, Job.state.in_(list(job_ends)), ~known).order_by(Job.finished)


def _add(session: Session, target: str, job_id: str) -> Delivery:
    delivery = Delivery(id=uuid.uuid4().hex, target=target, job_id=job_id, state=DeliveryState.PENDING)
    session.add(delivery)
    session.flush()
    return delivery


def claim(session: Session, target: str, sender: str) -> Claim | None:
    """Claim the oldest due delivery of a target, if there is one."""
    oldest = (
        select(Delivery.id)
        .where(Delivery.target == target, _due())
        .order_by(Delivery.due, Delivery.id)
        .limit(1)
        .with_for_update(skip_locked=True)
    )
    found = session.scalar(oldest)
    row = session.execute(
        update(Delivery)
        .where(Delivery.id == found, Delivery.state == DeliveryState.PENDING)
        .values(
            state=DeliveryState.SENDING,
            attempt=Delivery.attempt + 1,
            lease_until=db_now() + settings().lease_seconds,
            sender=sender,
        )
        .returning(Delivery.id, Delivery.job_id, Delivery.target, Delivery.attempt)
    ).first()
    return None if row is None else Claim(*row)


def extend(session: Session, held: Claim) -> bool:
    """Extend the lease. Return False when the claim was lost."""
    return _change(session, held, lease_until=db_now() + settings().lease_seconds)


def begin_objects(session: Session, held: Claim, objects: Mapping[str, str]) -> dict[str, ObjectState]:
    """Return the state of each object of a delivery whose attempt begins.

    The attempt counts for the objects that have not arrived.

    Parameters
    ----------
    session : Session
    held : Claim
    objects : mapping
        SOP Instance UID -> file name.

    Raises
    ------
    ClaimLost
    """
    _demand(session, held)
    add_objects(session, held.delivery_id, objects)
    session.execute(
        update(DeliveryObject)
        .where(DeliveryObject.delivery_id == held.delivery_id, DeliveryObject.state != ObjectState.DELIVERED)
        .values(attempts=DeliveryObject.attempts + 1)
    )
    return {row.sop_instance_uid: ObjectState(row.state) for row in objects_of(session, held.delivery_id)}


def add_objects(session: Session, delivery_id: str, objects: Mapping[str, str]) -> None:
    """Add the objects of a delivery that it lacks; SOP Instance UID -> file name."""
    known = {row.sop_instance_uid for row in objects_of(session, delivery_id)}
    session.add_all(
        DeliveryObject(delivery_id=delivery_id, sop_instance_uid=uid, name=name, state=ObjectState.PENDING)
        for uid, name in objects.items()
        if uid not in known
    )
    session.flush()


def set_object_state(session: Session, held: Claim, uid: str, state: ObjectState) -> None:
    """Store the state of an object.

    Raises
    ------
    ClaimLost
    """
    _demand(session, held)
    session.execute(
        update(DeliveryObject)
        .where(DeliveryObject.delivery_id == held.delivery_id, DeliveryObject.sop_instance_uid == uid)
        .values(state=state, delivered=db_now() if state == ObjectState.DELIVERED else None)
    )
    if state == ObjectState.DELIVERED:
        tally.add(session, {f"delivered_objects|{held.target}": 1.0})


class ClaimLost(Exception):
    """Another sender has the delivery, or its job was deleted."""


def finish(session: Session, held: Claim) -> bool:
    """Store that everything was delivered. Return False when the claim was lost."""
    changed = _change(
        session, held, state=DeliveryState.DELIVERED, error=None, lease_until=None, failures=0, finished=db_now()
    )
    if changed:
        _note(session, held, None, DeliveryState.DELIVERED)
    return changed


def fail(session: Session, held: Claim, failure: Failure, *, wait_seconds: float | None, give_up_days: float) -> bool:
    """Store that an attempt failed.

    Parameters
    ----------
    session : Session
    held : Claim
    failure : Failure
    wait_seconds : float or None
        Time until the next attempt; None when no other attempt can succeed.
    give_up_days : float
        Time since the first attempt, or since somebody asked for another one, after which none follows.

    Returns
    -------
    bool
        False when the claim was lost.
    """
    since = session.scalar(select(db_now() - Delivery.since).where(Delivery.id == held.delivery_id)) or 0.0
    over = wait_seconds is None or since + wait_seconds > give_up_days * DAY_SECONDS
    changed = _change(
        session,
        held,
        state=DeliveryState.FAILED if over else DeliveryState.PENDING,
        error={"code": failure.code, "detail": failure.detail},
        lease_until=None,
        failures=Delivery.failures + 1,
        due=db_now() + (wait_seconds or 0.0),
        finished=db_now() if over else None,
    )
    if changed:
        _note(session, held, failure, DeliveryState.FAILED if over else None)
    return changed


def failures_of(session: Session, held: Claim) -> int:
    """Return how many attempts failed in a row.

    A request to try again begins the count anew.
    """
    return session.scalar(select(Delivery.failures).where(Delivery.id == held.delivery_id)) or 0


def reap(session: Session, target: str) -> int:
    """Free the deliveries of a target whose sender fell silent, and return how many."""
    longest = db_now() + settings().lease_seconds
    session.execute(
        update(Delivery)
        .where(
            Delivery.target == target,
            Delivery.state == DeliveryState.SENDING,
            Delivery.lease_until > longest + CLOCK_TOLERANCE_SECONDS,
        )
        .values(lease_until=longest)
    )
    freed = session.execute(
        update(Delivery)
        .where(Delivery.target == target, _expired())
        .values(state=DeliveryState.PENDING, lease_until=None, due=db_now())
        .returning(Delivery.id, Delivery.job_id, Delivery.target, Delivery.attempt)
    ).all()
    for row in freed:
        _note(session, Claim(*row), _LOST, None)
    return len(freed)


def retry(session: Session, delivery_id: str) -> Delivery:
    """Try a delivery again at once.

    Its time before it is given up begins anew. A delivery that has arrived is not changed.

    Raises
    ------
    Problem
        404 when there is none.
    """
    # A sender may hold the row; the new values must not meet an old copy of it.
    query = select(Delivery).where(Delivery.id == delivery_id).with_for_update()
    delivery = session.scalars(query.execution_options(populate_existing=True)).one_or_none()
    if delivery is None:
        raise not_found("delivery")
    if delivery.state == DeliveryState.DELIVERED:
        return delivery
    now = session.scalar(select(db_now())) or 0.0
    delivery.since, delivery.failures = now, 0
    if delivery.state != DeliveryState.SENDING:
        delivery.state, delivery.due, delivery.finished = DeliveryState.PENDING, now, None
    session.flush()
    return delivery


def target_kind(session: Session, job_id: str, target: str) -> str:
    """Return the kind of a target that a job can be delivered to.

    Raises
    ------
    Problem
        404 when there is no such job; 409 ``not_ready`` while it runs; 422 ``unknown_target``.
    """
    job = session.get(Job, job_id, options=[defer(Job.snapshot)])
    if job is None:
        raise not_found("job")
    row = session.get(DeliveryTarget, target)
    if row is None:
        raise Problem(
            422, "unknown_target", "There is no such target; add it to the configuration file and start the service again.",
            [("target", "unknown")],
        )  # fmt: skip
    if job.state not in ENDED_JOB:
        raise Problem(409, "not_ready", "The job has not ended yet; follow the job and ask again.")
    return row.kind


def request(session: Session, job_id: str, target: str) -> Delivery:
    """Ask for the delivery of an ended job to a target.

    The job may have ended before the target was registered. A delivery that exists is tried again.

    Raises
    ------
    Problem
        As :func:`target_kind`.
    """
    target_kind(session, job_id, target)
    _lock_target(session, target)
    known = session.scalar(select(Delivery.id).where(Delivery.job_id == job_id, Delivery.target == target))
    return _add(session, target, job_id) if known is None else retry(session, known)


def objects_of(session: Session, delivery_id: str) -> Sequence[DeliveryObject]:
    """Return the objects of a delivery in the order of sending."""
    query = select(DeliveryObject).where(DeliveryObject.delivery_id == delivery_id).order_by(DeliveryObject.id)
    return session.scalars(query).all()


def attempts_of(session: Session, delivery_id: str) -> Sequence[DeliveryAttempt]:
    """Return the attempts of a delivery that have ended, oldest first."""
    query = select(DeliveryAttempt).where(DeliveryAttempt.delivery_id == delivery_id).order_by(DeliveryAttempt.id)
    return session.scalars(query).all()


def _due() -> Any:
    return and_(Delivery.state == DeliveryState.PENDING, Delivery.due <= db_now())


def _expired() -> Any:
    return and_(Delivery.state == DeliveryState.SENDING, Delivery.lease_until < db_now())


def _held(held: Claim) -> tuple[Any, ...]:
    return (
        Delivery.id == held.delivery_id,
        Delivery.attempt == held.attempt,
        Delivery.state == DeliveryState.SENDING,
    )


def _change(session: Session, held: Claim, **values: Any) -> bool:
    changed = update(Delivery).where(*_held(held)).values(**values).returning(Delivery.id)
    return session.execute(changed).first() is not None


def _demand(session: Session, held: Claim) -> None:
    """Check the claim and lock its row until the end of the transaction."""
    if not extend(session, held):
        raise ClaimLost


def _note(session: Session, held: Claim, failure: Failure | None, end: DeliveryState | None) -> None:
    """Add an attempt to the history, its end to the sums and the audit trail."""
    session.add(
        DeliveryAttempt(
            delivery_id=held.delivery_id,
            number=held.attempt,
            code=failure and failure.code,
            detail=failure and failure.detail,
        )
    )
    counts = {} if failure is None else {f"delivery_failures|{held.target}": 1.0}
    if end is not None:
        counts[f"deliveries|{held.target}|{end}"] = 1.0
        audit.append(session, [Act("sender", f"delivery to {held.target}: {end}", job=held.job_id)])
    if counts:
        tally.add(session, counts)
