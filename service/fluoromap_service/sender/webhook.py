"""A webhook: a signed message to a program when a job has ended."""

from __future__ import annotations

import hashlib
import hmac
import json
import time

from sqlalchemy.orm import defer

from fluoromap_service.api.http.timestamps import rfc3339_or_none
from fluoromap_service.deliveries.outbox import Claim, ClaimLost
from fluoromap_service.deliveries.targets import WebhookTarget
from fluoromap_service.sender.http_targets import connected, refused, secret_of
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job


def send(target: WebhookTarget, held: Claim) -> None:
    """Send the message of a delivery.

    The message has ids and no data of the patient. A repeated message has the same ``Fluoromap-Delivery``.

    Raises
    ------
    NotDelivered
        When the target did not answer with a status of 200 to 299.
    ClaimLost
        When the job was deleted.
    """
    body = message_of(held)
    moment = str(int(time.time()))
    headers = {
        "Content-Type": "application/json",
        "Fluoromap-Delivery": held.delivery_id,
        "Fluoromap-Timestamp": moment,
        "Fluoromap-Signature": f"sha256={signature(secret_of(target.secret_file), moment, body)}",
    }
    with connected(target, headers) as connection:
        answer = connection.post(str(target.url), [body])
    if not answer.is_success:
        raise refused(answer.status, "the message")


def signature(secret: str, moment: str, body: bytes) -> str:
    """Return the HMAC-SHA256 of time, full stop and body, in hexadecimal digits."""
    return hmac.new(secret.encode(), moment.encode() + b"." + body, hashlib.sha256).hexdigest()


def message_of(held: Claim) -> bytes:
    """Return the message about the job of a delivery, as JSON."""
    with reading() as session:
        job = session.get(Job, held.job_id, options=[defer(Job.snapshot)])
        if job is None:
            raise ClaimLost
        message = {
            "delivery": held.delivery_id,
            "event": "job_ended",
            "study": job.study_id,
            "job": job.id,
            "state": job.state,
            "error": job.error and job.error.get("code"),
            "finished": rfc3339_or_none(job.finished),
            "result": f"/v1/jobs/{job.id}",
        }
    return json.dumps(message).encode()
