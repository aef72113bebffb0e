"""Deliveries against real peers: each object arrives once, whatever happens on the way."""

from __future__ import annotations

import hashlib
import hmac
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pydicom
import pytest
from delivery_peers import Archive, Inbox, dicom_node, dicomweb_server, endless_server, webhook_receiver
from finished_study import FinishedStudy, edit_runs, make_study
from pydicom.dataset import Dataset
from pynetdicom import evt
from raw_headers import UNUSUAL, with_raw_values
from sqlalchemy import select, update
from structlog.testing import capture_logs

from fluoromap_service.api.results.result_objects import delivery_objects
from fluoromap_service.cli.supervisor import free_port
from fluoromap_service.deliveries import outbox
from fluoromap_service.deliveries.targets import CStoreTarget, StowTarget, WebhookTarget
from fluoromap_service.jobs import job_life
from fluoromap_service.sender.peers import NotDelivered
from fluoromap_service.sender.service import Sender, send_next
from fluoromap_service.sender.stow import open_server
from fluoromap_service.settings import settings
from fluoromap_service.store import audit, tally
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Delivery, DeliveryTarget, Job, Study
from fluoromap_service.study import studies
from fluoromap_service.study.snapshot import Snapshot

Serve = Callable[[Archive], AbstractContextManager[CStoreTarget | StowTarget]]
BOTH = pytest.mark.parametrize("serve", [dicom_node, dicomweb_server], ids=["dicom", "dicomweb"])
OUT_OF_RESOURCES = 0xA700
SECRET = "0123456789abcdef"
PATIENCE_SECONDS = 240
"""A sender that never ends would hold the test up for ever."""


def objects_of(study: FinishedStudy) -> dict[str, Dataset]:
    """Return the result objects of a job by their SOP Instance UID."""
    read = [pydicom.dcmread(io.BytesIO(item.content)) for item in delivery_objects(study.job_id)]
    return {item.SOPInstanceUID: item for item in read}


def delivery(job_id: str) -> Delivery:
    with reading() as session:
        return session.scalars(select(Delivery).where(Delivery.job_id == job_id)).one()


def another_job(study: FinishedStudy) -> FinishedStudy:
    """Make another job of the study, none of whose stages has begun."""
    with writing() as session:
        first = session.get_one(Job, study.job_id)
        job = job_life.create(session, study.study_id, Snapshot.model_validate(first.snapshot))
    return FinishedStudy(study.study_id, job.id, study.uids)


def history(job_id: str) -> list[str | None]:
    """Return the outcomes of a delivery's attempts."""
    row = delivery(job_id)
    with reading() as session:
        return [attempt.code for attempt in outbox.attempts_of(session, row.id)]


def attempt_again(target: Any) -> None:
    """Make the waiting delivery due and attempt it."""
    with writing() as session:
        session.execute(update(Delivery).values(due=db_now() - 1))
    assert send_next(target)


@BOTH
def test_objects_arrive_as_they_are(study: FinishedStudy, serve: Serve) -> None:
    archive = Archive()
    with serve(archive) as target:
        assert send_next(target)
        assert not send_next(target)
    assert {item.SOPInstanceUID: item for item in archive.stored} == objects_of(study)
    assert len(archive.stored) == len(objects_of(study))
    assert archive.questions == 0
    row = delivery(study.job_id)
    assert (row.state, row.attempt, row.error, history(study.job_id)) == ("delivered", 1, None, [None])
    with reading() as session:
        sums = tally.all_sums(session)
        acts = [(act.who, act.what, act.study, act.job) for act in audit.entries(session)]
    assert sums[f"delivered_objects|{target.name}"] == len(archive.stored)
    assert acts == [("sender", f"delivery to {target.name}: delivered", study.study_id, study.job_id)]


@BOTH
@pytest.mark.parametrize("kind", ["charset_leading_empty_ISO2022IR87", "everything_at_once"])
def test_results_of_unusual_headers_arrive(study: FinishedStudy, serve: Serve, kind: str) -> None:
    edit_runs(study, lambda content: with_raw_values(content, UNUSUAL[kind]))
    archive = Archive()
    with serve(archive) as target:
        assert send_next(target)
    assert {item.SOPInstanceUID: item for item in archive.stored} == objects_of(study)
    row = delivery(study.job_id)
    assert (row.state, row.error) == ("delivered", None)


def test_target_that_was_away_for_a_day(study: FinishedStudy) -> None:
    archive, port = Archive(), free_port()
    away = CStoreTarget(name="pacs", kind="dicom", host="127.0.0.1", port=port, aet="PACS", first_wait_seconds=30)
    for failures in range(1, 25):
        assert send_next(away) if failures == 1 else attempt_again(away) is None
        row = delivery(study.job_id)
        assert row.error is not None
        assert (row.state, row.failures, row.error["code"]) == ("pending", failures, "unreachable")
        with reading() as session:
            wait = session.scalar(select(Delivery.due - db_now()))
        expected = min(30 * 2 ** (failures - 1), 3600)
        assert expected - 20 < wait <= expected
        # Not before its time.
        assert not send_next(away)
    with dicom_node(archive, port=port):
        attempt_again(away)
    assert Counter(archive.uids) == Counter(objects_of(study).keys())
    assert delivery(study.job_id).state == "delivered"


def test_given_up_after_days_and_tried_again_on_request(study: FinishedStudy) -> None:
    archive, port = Archive(), free_port()
    away = CStoreTarget(name="pacs", kind="dicom", host="127.0.0.1", port=port, aet="PACS")
    assert send_next(away)
    with writing() as session:
        session.execute(update(Delivery).values(since=Delivery.since - 7 * outbox.DAY_SECONDS))
    attempt_again(away)
    row = delivery(study.job_id)
    assert row.state == "failed"
    assert row.finished is not None
    with dicom_node(archive, port=port):
        assert not send_next(away)
        with writing() as session:
            outbox.retry(session, row.id)
        assert send_next(away)
    assert len(archive.stored) == len(objects_of(study))
    with writing() as session:
        assert outbox.retry(session, row.id).state == "delivered"
    assert not send_next(away)


@BOTH
def test_refused_object_is_sent_again_and_no_other(study: FinishedStudy, serve: Serve) -> None:
    refusals = [None, OUT_OF_RESOURCES, OUT_OF_RESOURCES]
    archive = Archive(arrival=lambda item: refusals.pop(0) if refusals else None)
    with serve(archive) as target:
        send_next(target)
        assert len(archive.stored) == 1
        attempt_again(target)
        attempt_again(target)
    assert Counter(archive.uids) == Counter(objects_of(study).keys())
    assert history(study.job_id) == ["object_refused", "object_refused", None]


def test_target_that_has_an_object_already_counts_as_delivered(study: FinishedStudy) -> None:
    with dicomweb_server(Archive(arrival=lambda item: 0x0111)) as target:
        send_next(target)
    assert delivery(study.job_id).state == "delivered"


@pytest.mark.parametrize(
    ("options", "changes", "code"),
    [({}, {"aet": "OTHER"}, "association_rejected"), ({"classes": 5}, {}, "class_not_accepted")],
    ids=["title", "classes"],
)
def test_refusals_of_the_negotiation(study: FinishedStudy, options: Any, changes: Any, code: str) -> None:
    archive = Archive()
    with dicom_node(archive, **options) as target:
        send_next(target.model_copy(update=changes))
    assert history(study.job_id) == [code]
    assert archive.stored == []


OK = b"HTTP/1.1 200 OK\r\nContent-Type: application/dicom+json\r\n"


@pytest.mark.parametrize(
    ("head", "part", "pause_seconds", "code"),
    [
        (OK + b"\r\n", b" " * 2**16, 0.0, "answer_too_long"),
        (OK + b"Content-Length: 600000000\r\n\r\n", b" " * 2**16, 0.0, "answer_too_long"),
        (OK + b"\r\n", b" ", 0.05, "answer_too_slow"),
        # One header field that never ends.
        (OK + b"X: ", b"x", 0.05, "answer_too_slow"),
    ],
    ids=["endless", "600 MB", "dripping", "dripping header"],
)
@pytest.mark.parametrize("kind", ["dicomweb", "webhook"])
def test_answer_without_end(
    study: FinishedStudy, tmp_path: Path, kind: str, head: bytes, part: bytes, pause_seconds: float, code: str
) -> None:
    with endless_server(head, part, pause_seconds) as (url, taken):
        # The target is never silent, so the limit for silence does not end the attempt.
        if kind == "dicomweb":
            send_next(StowTarget(name="archive", kind="dicomweb", url=url, timeout_seconds=1.0))
        else:
            send_next(hook(tmp_path, url, timeout_seconds=1.0))
        assert history(study.job_id) == [code]
        end = time.monotonic() + PATIENCE_SECONDS
        while not taken:
            assert time.monotonic() < end, "the sender still reads"
            time.sleep(0.01)
    # The buffers of both sockets hold some megabytes beside what the sender has read.
    assert taken[0] < 50 * 2**20


def test_question_whose_answers_never_end(study: FinishedStudy) -> None:
    archive = Archive()

    def lose_answer(event: evt.Event) -> int:
        archive.take(event.dataset)
        event.assoc.abort()
        return 0x0000

    def match_for_ever(event: evt.Event) -> Iterator[tuple[int, Dataset]]:
        while event.assoc.is_established:
            yield 0xFF00, event.identifier

    with dicom_node(archive, handlers=[(evt.EVT_C_STORE, lose_answer)]) as target:
        send_next(target)
    with dicom_node(archive, port=target.port, handlers=[(evt.EVT_C_FIND, match_for_ever)]):
        attempt_again(target)
    assert history(study.job_id) == ["connection_lost", "answer_too_long"]


@pytest.mark.parametrize(
    ("url", "allowed", "sends"),
    [
        ("http://192.0.2.8/dicom-web", False, False),
        ("http://archive.example/dicom-web", False, False),
        ("http://192.0.2.8/dicom-web", True, True),
        ("https://192.0.2.8/dicom-web", False, True),
        ("http://127.0.0.1/dicom-web", False, True),
        ("http://[::1]/dicom-web", False, True),
        ("http://localhost/dicom-web", False, True),
    ],
)
def test_authorization_crosses_no_network_without_tls(tmp_path: Path, url: str, allowed: bool, sends: bool) -> None:
    secret = tmp_path / "authorization"
    secret.write_text(f"Bearer {SECRET}\n")
    target = StowTarget(name="archive", kind="dicomweb", url=url, authorization_file=secret, allow_insecure=allowed)
    if sends:
        with open_server(target):
            pass
    else:
        with pytest.raises(NotDelivered, match="allow_insecure") as failure, open_server(target):
            pass
        assert failure.value.failure.code == "insecure_target"
    with capture_logs() as entries:
        Sender([target])
    warned = any(entry["event"] == "authorization_without_tls" for entry in entries)
    assert warned is (allowed or not sends)
    # Without a secret, a plain target is allowed: DICOM itself often has no TLS.
    with open_server(target.model_copy(update={"authorization_file": None, "allow_insecure": False})):
        pass


def test_authorization_is_sent_to_a_loopback_target(study: FinishedStudy, tmp_path: Path) -> None:
    secret = tmp_path / "authorization"
    secret.write_text(f"Bearer {SECRET}\n")
    archive = Archive()
    with dicomweb_server(archive) as target:
        send_next(target.model_copy(update={"authorization_file": secret}))
    assert Counter(archive.uids) == Counter(objects_of(study).keys())
    assert set(archive.authorizations) == {f"Bearer {SECRET}"}


def test_target_that_dies_in_the_middle(study: FinishedStudy) -> None:
    archive = Archive()

    def die(event: evt.Event) -> int:
        if len(archive.stored) == 2:
            event.assoc.abort()
        else:
            archive.take(event.dataset)
        return 0x0000

    with dicom_node(archive, handlers=[(evt.EVT_C_STORE, die)]) as target:
        send_next(target)
    assert history(study.job_id) == ["connection_lost"]
    with dicom_node(archive, port=target.port):
        attempt_again(target)
    assert Counter(archive.uids) == Counter(objects_of(study).keys())


def test_answer_that_was_lost_is_asked_for(study: FinishedStudy) -> None:
    archive = Archive()

    def lose_answer(event: evt.Event) -> int:
        archive.take(event.dataset)
        event.assoc.abort()
        return 0x0000

    with dicom_node(archive, handlers=[(evt.EVT_C_STORE, lose_answer)]) as target:
        send_next(target)
    assert len(archive.stored) == 1
    with dicom_node(archive, port=target.port):
        attempt_again(target)
    assert archive.questions == 1
    assert Counter(archive.uids) == Counter(objects_of(study).keys())


def test_target_without_queries_gets_an_uncertain_object_again(study: FinishedStudy) -> None:
    statuses = [OUT_OF_RESOURCES]
    archive = Archive(arrival=lambda item: statuses.pop(0) if statuses else None)
    with dicom_node(archive, answers_questions=False) as target:
        send_next(target)
        attempt_again(target)
    assert Counter(archive.uids) == Counter(objects_of(study).keys())


@pytest.fixture
def short_lease(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Leases of half a second."""
    monkeypatch.setenv("FLUOROMAP_LEASE_SECONDS", "0.5")
    monkeypatch.setenv("FLUOROMAP_HEARTBEAT_SECONDS", "0.1")
    settings.cache_clear()
    yield
    settings.cache_clear()


@contextmanager
def killable_senders(target: CStoreTarget | StowTarget) -> Iterator[subprocess.Popen[str]]:
    """Run the program of the killable senders, for ``PATIENCE_SECONDS`` at most.

    Its own session lets the test end it together with the sender that it has forked.
    """
    program = [sys.executable, str(Path(__file__).with_name("killable_sender.py")), target.kind]
    with subprocess.Popen(
        program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as senders:  # fmt: skip
        end = threading.Timer(PATIENCE_SECONDS, os.killpg, (senders.pid, signal.SIGKILL))
        end.start()
        try:
            yield senders
        finally:
            end.cancel()
            os.killpg(senders.pid, signal.SIGKILL)


@BOTH
@pytest.mark.usefixtures("short_lease")
def test_sender_killed_twenty_times_delivers_everything_once(study: FinishedStudy, serve: Serve) -> None:
    jobs = [study, *(another_job(study) for _ in range(3))]
    for more in jobs[1:]:
        more.finish()
    expected = Counter(item.sop_instance_uid for job in jobs for item in delivery_objects(job.job_id))
    kills, seen = Counter[str](), Counter[str]()
    running: list[int] = []

    def kill(when: str) -> None:
        kills[when] += 1
        os.kill(running[-1], signal.SIGKILL)

    def arrival(item: Dataset) -> int | None:
        # The first time an object arrives, the sender dies before the target stores it.
        seen[item.SOPInstanceUID] += 1
        if seen[item.SOPInstanceUID] == 1 and kills.total() < 20:
            kill("before it was stored")
            return OUT_OF_RESOURCES
        return None

    def on_stored(item: Dataset) -> None:
        # The sender dies before it gets the answer.
        if kills.total() < 20:
            kill("after it was stored")

    archive = Archive(arrival=arrival, on_stored=on_stored)
    with serve(archive) as target:
        with killable_senders(target) as senders:
            assert senders.stdin is not None
            assert senders.stdout is not None
            senders.stdin.write(target.model_dump_json() + "\n")
            for _ in range(20):
                senders.stdin.write("\n")
                senders.stdin.flush()
                running.append(int(senders.stdout.readline()))
                assert senders.stdout.readline() == "ended\n"
            senders.stdin.close()
        end = time.monotonic() + PATIENCE_SECONDS
        while not all(delivery(job.job_id).state == "delivered" for job in jobs):
            assert time.monotonic() < end, [history(job.job_id) for job in jobs]
            send_next(target)
    assert kills.total() == 20
    assert min(kills.values()) >= 8
    assert Counter(archive.uids) == expected
    assert sum(history(job.job_id).count("sender_lost") for job in jobs) == 20


def test_jobs_from_before_the_target_are_sent_on_request_only(study: FinishedStudy) -> None:
    archive = Archive()
    with writing() as session:
        session.execute(update(DeliveryTarget).values(since=db_now() + 100))
    with dicom_node(archive) as target:
        assert not send_next(target)
        with writing() as session:
            outbox.request(session, study.job_id, "pacs")
        assert send_next(target)
    assert len(archive.stored) == len(objects_of(study))


def test_job_without_objects_fails_at_once(study: FinishedStudy) -> None:
    archive = Archive()
    with dicom_node(archive) as target:
        send_next(target)
        empty = another_job(study)
        for uid in empty.uids.values():
            empty.fail("segment", uid)
        with writing() as session:
            outbox.request(session, empty.job_id, "pacs")
        assert send_next(target)
    row = delivery(empty.job_id)
    assert row.error is not None
    assert (row.state, row.error["code"]) == ("failed", "not_ready")


def test_study_deleted_while_its_results_are_sent(study: FinishedStudy) -> None:
    def arrival(item: Dataset) -> None:
        with writing() as session:
            if session.get(Study, study.study_id):
                studies.remove(session, study.study_id)

    archive = Archive(arrival=arrival)
    with dicom_node(archive) as target:
        assert send_next(target)
        assert not send_next(target)
    assert len(archive.stored) == 1


def hook(tmp_path: Path, url: str, **more: Any) -> WebhookTarget:
    secret = tmp_path / "secret"
    secret.write_text(SECRET + "\n")
    return WebhookTarget(
        name="hook", kind="webhook", url=url, secret_file=secret, first_wait_seconds=1e-3, **more
    )  # fmt: skip


def test_webhook_is_signed_and_names_no_patient(study: FinishedStudy, tmp_path: Path) -> None:
    inbox = Inbox(statuses=[503, 302])
    with webhook_receiver(inbox) as url:
        target = hook(tmp_path, url)
        send_next(target)
        attempt_again(target)
        attempt_again(target)
    assert history(study.job_id) == ["object_refused", "object_refused", None]
    assert len(inbox.messages) == 3
    assert len({headers["Fluoromap-Delivery"] for headers, _ in inbox.messages}) == 1
    headers, body = inbox.messages[-1]
    signed = f"{headers['Fluoromap-Timestamp']}.".encode() + body
    expected = hmac.new(SECRET.encode(), signed, hashlib.sha256).hexdigest()
    assert headers["Fluoromap-Signature"] == f"sha256={expected}"
    message = json.loads(body)
    assert message.pop("finished").endswith("Z")
    assert message == {
        "delivery": headers["Fluoromap-Delivery"], "event": "job_ended", "study": study.study_id, "job": study.job_id,
        "state": "succeeded", "error": None, "result": f"/v1/jobs/{study.job_id}",
    }  # fmt: skip


def test_webhook_hears_of_failed_jobs_too(data_dir: Path, tmp_path: Path) -> None:
    inbox = Inbox()
    with webhook_receiver(inbox) as url:
        target = hook(tmp_path, url)
        with writing() as session:
            outbox.register(session, [target])
        study = make_study()
        for uid in study.uids.values():
            study.fail("segment", uid)
        assert send_next(target)
    (message,) = [json.loads(body) for _, body in inbox.messages]
    assert (message["state"], message["error"]) == ("failed", "plugin_failed")


def test_webhook_without_its_secret_sends_nothing(study: FinishedStudy, tmp_path: Path) -> None:
    inbox = Inbox()
    with webhook_receiver(inbox) as url:
        target = hook(tmp_path, url)
        target.secret_file.unlink()
        send_next(target)
    assert inbox.messages == []
    assert history(study.job_id) == ["configuration"]


def test_neither_log_nor_history_quotes_a_target(
    study: FinishedStudy, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = Archive()

    def refuse(event: evt.Event) -> Dataset:
        answer = Dataset()
        answer.Status = OUT_OF_RESOURCES
        answer.ErrorComment = "no room for DOE^JANE"
        return answer

    with dicom_node(archive, handlers=[(evt.EVT_C_STORE, refuse)]) as target:
        send_next(target)
    row = delivery(study.job_id)
    assert row.error is not None
    assert "A700" in row.error["detail"]
    printed = capfd.readouterr()
    names = {str(item.PatientName) for item in objects_of(study).values()} | {"DOE", *objects_of(study)}
    for text in (printed.out, printed.err, row.error["detail"]):
        assert not [name for name in names if name in text]
