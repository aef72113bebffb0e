"""The loop of the sender: one thread for each target, so that a target that is away holds no other one up."""

from __future__ import annotations

import logging
import os
import socket
import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager
from types import TracebackType

import structlog
from sqlalchemy.exc import SQLAlchemyError

from fluoromap_service.api.results.result_objects import OutgoingObject, delivery_objects
from fluoromap_service.deliveries import outbox
from fluoromap_service.deliveries.outbox import Claim, ClaimLost
from fluoromap_service.deliveries.targets import CStoreTarget, StowTarget, Target, WebhookTarget
from fluoromap_service.problem import Problem
from fluoromap_service.sender import webhook
from fluoromap_service.sender.c_store import associated
from fluoromap_service.sender.peers import NotDelivered, Peer
from fluoromap_service.sender.stow import open_server, shows_secret
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import ObjectState

LOOK_SECONDS = 1.0
"""Time between two looks into the outbox."""
STOP_SECONDS = 20.0
"""Time that a running attempt gets to end."""

log = structlog.get_logger(__name__)


class Sender:
    """The threads that serve the targets.

    Parameters
    ----------
    targets : sequence of Target
    """

    def __init__(self, targets: Sequence[Target]) -> None:
        # pynetdicom's own lines may quote headers; this module logs what happens.
        logging.getLogger("pynetdicom").setLevel(logging.CRITICAL)
        for target in targets:
            if isinstance(target, StowTarget) and shows_secret(target):
                log.warning("authorization_without_tls", target=target.name, allowed=target.allow_insecure)
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._serve, args=(target,), daemon=True) for target in targets]

    def start(self) -> None:
        """Start all threads."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Claim nothing new, and wait ``STOP_SECONDS`` for the running attempts."""
        self._stop.set()
        for thread in self._threads:
            thread.join(STOP_SECONDS)

    def _serve(self, target: Target) -> None:
        away = False
        while True:
            try:
                while not self._stop.is_set() and send_next(target):
                    pass
                away = False
            except SQLAlchemyError as error:
                # The database may come back: log the first failure only.
                if not away:
                    log.warning("database_away", target=target.name, error=type(error).__name__)
                away = True
            if self._stop.wait(LOOK_SECONDS):
                return


def send_next(target: Target) -> bool:
    """Send the next delivery of a target that is due.

    Return whether there was one.
    """
    with reading() as session:
        if not outbox.needs_work(session, target.name, target.job_ends):
            return False
    with writing() as session:
        outbox.reap(session, target.name)
        outbox.plan(session, target.name, target.job_ends)
        held = outbox.claim(session, target.name, f"{socket.gethostname()}:{os.getpid()}")
    if held is None:
        return False
    bound = log.bind(target=target.name, delivery=held.delivery_id, job=held.job_id, attempt=held.attempt)
    bound.info("delivery_started")
    with _Lease(held):
        try:
            _send(target, held)
        except ClaimLost:
            bound.warning("delivery_lost")
        except NotDelivered as error:
            bound.warning("delivery_failed", code=error.failure.code)
            _fail(target, held, error)
        except Problem as problem:
            # These results cannot be made into objects, now or later.
            bound.warning("delivery_impossible", code=problem.code)
            _fail(target, held, NotDelivered(problem.code, problem.detail), final=problem.status < 429)
        except SQLAlchemyError:
            # The lease ends, and the next attempt asks the target what has arrived.
            raise
        except Exception as error:
            bound.error("delivery_broken", error=type(error).__name__, exc_info=error)
            _fail(target, held, NotDelivered("internal", "The sender failed; look into its log and report the fault."))
        else:
            with writing() as session:
                delivered = outbox.finish(session, held)
            bound.info("delivery_done" if delivered else "delivery_lost")
    return True


def _fail(target: Target, held: Claim, error: NotDelivered, *, final: bool = False) -> None:
    with writing() as session:
        wait = None if final else target.wait_seconds(outbox.failures_of(session, held) + 1)
        outbox.fail(session, held, error.failure, wait_seconds=wait, give_up_days=target.give_up_days)


def _send(target: Target, held: Claim) -> None:
    if isinstance(target, WebhookTarget):
        webhook.send(target, held)
        return
    objects = delivery_objects(held.job_id)
    with writing() as session:
        states = outbox.begin_objects(session, held, {item.sop_instance_uid: item.name for item in objects})
    waiting = [item for item in objects if states[item.sop_instance_uid] != ObjectState.DELIVERED]
    if not waiting:
        return
    with _peer(target, waiting) as peer:
        for item in waiting:
            uid = item.sop_instance_uid
            # A sender that died may have sent it. Only the target knows whether it arrived.
            if states[uid] != ObjectState.SENDING or not peer.has(item):
                with writing() as session:
                    outbox.set_object_state(session, held, uid, ObjectState.SENDING)
                peer.store(item)
            with writing() as session:
                outbox.set_object_state(session, held, uid, ObjectState.DELIVERED)


def _peer(target: CStoreTarget | StowTarget, objects: Sequence[OutgoingObject]) -> AbstractContextManager[Peer]:
    return associated(target, objects) if isinstance(target, CStoreTarget) else open_server(target)


class _Lease:
    """The thread that extends the lease of a claim while a block runs."""

    def __init__(self, held: Claim) -> None:
        self._held = held
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.set()
        self._thread.join()

    def _beat(self) -> None:
        while not self._end.wait(settings().heartbeat_seconds):
            try:
                with writing() as session:
                    outbox.extend(session, self._held)
            except SQLAlchemyError:
                # The next beat may reach the database; otherwise the lease ends.
                continue
