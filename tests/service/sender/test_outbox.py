"""The outbox on both databases: claims, leases, and senders that meet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from delivery_peers import TARGETS
from finished_study import FinishedStudy, make_study
from sqlalchemy import select, update

from fluoromap_service.deliveries import outbox
from fluoromap_service.deliveries.outbox import Failure
from fluoromap_service.settings import settings
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import engine, reading, writing
from fluoromap_service.store.models import Base, Delivery, ObjectState


@pytest.fixture(params=["sqlite", "postgresql"])
def job(request: pytest.FixtureRequest, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FinishedStudy]:
    """A job that succeeded after the target ``pacs`` was registered."""
    if request.param == "postgresql":
        monkeypatch.setenv("FLUOROMAP_DATABASE_URL", request.getfixturevalue("postgres_url"))
        settings.cache_clear()
        Base.metadata.create_all(engine())
    with writing() as session:
        outbox.register(session, TARGETS)
        outbox.register(session, TARGETS)
    made = make_study()
    made.finish()
    yield made
    engine().dispose()


def test_of_two_senders_one_has_a_delivery(job: FinishedStudy) -> None:
    with writing() as session:
        assert outbox.plan(session, "pacs", ["succeeded"]) == 1
        held = outbox.claim(session, "pacs", "first")
        assert held is not None
        assert outbox.claim(session, "pacs", "second") is None
        assert outbox.plan(session, "pacs", ["succeeded"]) == 0
    with writing() as session:
        session.execute(update(Delivery).values(lease_until=db_now() - 1))
        assert outbox.reap(session, "pacs") == 1
        again = outbox.claim(session, "pacs", "second")
        assert again is not None
    with writing() as session:
        # The first sender comes back and changes nothing.
        assert not outbox.extend(session, held)
        assert not outbox.finish(session, held)
        with pytest.raises(outbox.ClaimLost):
            outbox.begin_objects(session, held, {"1.2.3": "report.dcm"})
        assert outbox.begin_objects(session, again, {"1.2.3": "report.dcm"}) == {"1.2.3": ObjectState.PENDING}
        outbox.set_object_state(session, again, "1.2.3", ObjectState.DELIVERED)
        assert outbox.finish(session, again)
    with reading() as session:
        assert not outbox.needs_work(session, "pacs", ["succeeded"])


def test_requests_and_senders_at_once_make_one_delivery(job: FinishedStudy) -> None:
    def ask(number: int) -> None:
        with writing() as session:
            if number % 2:
                outbox.request(session, job.job_id, "pacs")
            else:
                outbox.plan(session, "pacs", ["succeeded"])

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(ask, range(16)))
    with reading() as session:
        assert len(session.scalars(select(Delivery.id)).all()) == 1


def test_many_senders_at_once_claim_each_delivery_once(job: FinishedStudy) -> None:
    def look(number: int) -> str | None:
        with writing() as session:
            outbox.reap(session, "pacs")
            held = outbox.claim(session, "pacs", str(number))
            return None if held is None else held.delivery_id

    with writing() as session:
        outbox.plan(session, "pacs", ["succeeded"])
    with ThreadPoolExecutor(8) as threads:
        claimed = Counter(filter(None, threads.map(look, range(16))))
    assert list(claimed.values()) == [1]


def test_lease_of_a_clock_that_was_set_back_is_cut(job: FinishedStudy) -> None:
    with writing() as session:
        outbox.plan(session, "pacs", ["succeeded"])
        outbox.claim(session, "pacs", "first")
        session.execute(update(Delivery).values(lease_until=db_now() + 86400))
        assert outbox.reap(session, "pacs") == 0
    with reading() as session:
        left = session.scalar(select(Delivery.lease_until - db_now()))
        assert left <= settings().lease_seconds


def test_failed_attempt_waits_and_is_given_up_in_the_end(job: FinishedStudy) -> None:
    failure = Failure("unreachable", "No answer.")
    with writing() as session:
        outbox.plan(session, "pacs", ["succeeded"])
        held = outbox.claim(session, "pacs", "first")
        assert held is not None
        assert outbox.fail(session, held, failure, wait_seconds=100.0, give_up_days=1)
        assert outbox.claim(session, "pacs", "first") is None
        assert not outbox.fail(session, held, failure, wait_seconds=100.0, give_up_days=1)
        session.execute(update(Delivery).values(due=db_now() - 1))
        again = outbox.claim(session, "pacs", "first")
        assert again is not None
        assert outbox.failures_of(session, again) == 1
        outbox.fail(session, again, failure, wait_seconds=100.0, give_up_days=0.001)
    with reading() as session:
        assert session.scalars(select(Delivery.state)).all() == ["failed"]
        assert [attempt.number for attempt in outbox.attempts_of(session, held.delivery_id)] == [1, 2]
