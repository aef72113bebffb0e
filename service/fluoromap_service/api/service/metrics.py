"""The route of the metrics, in the text format of Prometheus 0.0.4."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from fastapi import Request, Response
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from fluoromap_service.api.http.middleware.access_log import RequestCounts
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import METRICS, Monitor
from fluoromap_service.jobs.job_life import SECONDS_BUCKETS
from fluoromap_service.jobs.pipeline import STAGES
from fluoromap_service.store import disk, tally
from fluoromap_service.store.audit_head import HeadWatch
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import (
    ENDED_JOB,
    Delivery,
    DeliveryState,
    DeliveryTarget,
    Job,
    JobState,
    StageRow,
    StageState,
    WorkerSeen,
)

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
router = new_router(tags=["service"])


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric with its samples. A sample is a suffix of the name, labels and a value."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    text: str
    samples: list[tuple[str, Mapping[str, str], float]] = field(default_factory=list)

    def add(self, value: float, suffix: str = "", **labels: str) -> None:
        """Add a sample."""
        self.samples.append((suffix, labels, value))

    def lines(self) -> Iterator[str]:
        """Yield the lines of the text format."""
        yield f"# HELP {self.name} {self.text}"
        yield f"# TYPE {self.name} {self.kind}"
        for suffix, labels, value in self.samples:
            named = ",".join(f'{name}="{_escaped(label)}"' for name, label in labels.items())
            yield (
                f"{self.name}{suffix}{{{named}}} {_number(value)}" if named else f"{self.name}{suffix} {_number(value)}"
            )


def _escaped(label: str) -> str:
    return label.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _number(value: float) -> str:
    return "+Inf" if value == math.inf else f"{value:.10g}"


@router.get(
    METRICS,
    summary="Metrics for Prometheus",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}, **responses(401, 403)},
)
def metrics(request: Request, caller: Monitor) -> Response:
    """Return queues, durations, failures, disk and requests; no label holds patient data."""
    with reading() as session:
        sums = tally.all_sums(session)
        shown = [*_work(session), *_sums(sums), *_deliveries(session, sums)]
    shown += [
        *_audit(request.app.state.audit_heads),
        *_disk(),
        *_requests(request.app.state.counts, request.app.state.sign_ins.failures),
    ]
    return Response("".join(f"{line}\n" for metric in shown for line in metric.lines()), media_type=MEDIA_TYPE)


def _work(session: Session) -> Iterable[Metric]:
    jobs = Metric("fluoromap_jobs", "gauge", "Jobs that have not ended.")
    counts = select(Job.state, func.count()).where(Job.state.in_([JobState.QUEUED, JobState.RUNNING]))
    found = {state: float(count) for state, count in session.execute(counts.group_by(Job.state))}
    for job_state in (JobState.QUEUED, JobState.RUNNING):
        jobs.add(found.get(job_state, 0.0), state=job_state)

    stages = Metric("fluoromap_stages", "gauge", "Stages that wait for a worker or run.")
    waiting = [StageState.READY, StageState.RUNNING]
    rows = select(StageRow.name, StageRow.state, func.count()).where(StageRow.state.in_(waiting))
    queued = {
        (name, state): float(n) for name, state, n in session.execute(rows.group_by(StageRow.name, StageRow.state))
    }
    for name in STAGES:
        for state in waiting:
            stages.add(queued.get((name, state), 0.0), stage=name, state=state)

    oldest = Metric("fluoromap_oldest_ready_stage_seconds", "gauge", "Time that the oldest ready stage has waited.")
    age = select(func.max(db_now() - StageRow.ready_since)).where(StageRow.state == StageState.READY)
    oldest.add(max(session.scalar(age) or 0.0, 0.0))

    silence = Metric("fluoromap_worker_silence_seconds", "gauge", "Time since the last sign of life of any worker.")
    last = session.scalar(select(func.min(db_now() - WorkerSeen.seen)))
    silence.add(math.inf if last is None else max(last, 0.0))
    return [jobs, stages, oldest, silence]


def _sums(sums: Mapping[str, float]) -> Iterable[Metric]:
    ended = Metric("fluoromap_stages_total", "counter", "Stages that ended, by their state.")
    seconds = Metric("fluoromap_stage_seconds", "histogram", "Duration of the stages that were done.")
    reaped = Metric("fluoromap_leases_reaped_total", "counter", "Stages taken from a silent worker.")
    reaped.add(sums.get("leases_reaped", 0.0))
    for name in STAGES:
        for state in (StageState.DONE, StageState.FAILED, StageState.CANCELLED):
            ended.add(sums.get(f"stages|{name}|{state}", 0.0), stage=name, state=state)
        total = 0.0
        for limit in (*SECONDS_BUCKETS, math.inf):
            total += sums.get(f"stage_seconds_bucket|{name}|{limit:g}", 0.0)
            seconds.add(total, "_bucket", stage=name, le=_number(limit))
        seconds.add(sums.get(f"stage_seconds|{name}", 0.0), "_sum", stage=name)
        seconds.add(total, "_count", stage=name)
    jobs = Metric("fluoromap_jobs_total", "counter", "Jobs that ended, by their state.")
    for job_state in sorted(ENDED_JOB):
        jobs.add(sums.get(f"jobs|{job_state}", 0.0), state=job_state)
    return [ended, seconds, reaped, jobs]


def _deliveries(session: Session, sums: Mapping[str, float]) -> Iterable[Metric]:
    waiting = Metric("fluoromap_deliveries", "gauge", "Deliveries that wait for their target or are being sent.")
    oldest = Metric("fluoromap_oldest_delivery_seconds", "gauge", "Age of the oldest delivery that has not ended.")
    ended = Metric("fluoromap_deliveries_total", "counter", "Deliveries that ended, by their state.")
    failures = Metric("fluoromap_delivery_failures_total", "counter", "Attempts of deliveries that failed.")
    objects = Metric("fluoromap_delivered_objects_total", "counter", "DICOM objects that targets confirmed.")
    open_states = (DeliveryState.PENDING, DeliveryState.SENDING)
    counts = (
        select(Delivery.target, Delivery.state, func.count(), func.max(db_now() - Delivery.since))
        .where(Delivery.state.in_(open_states))
        .group_by(Delivery.target, Delivery.state)
    )
    found = {(target, state): (float(n), age) for target, state, n, age in session.execute(counts)}
    for target in session.scalars(select(DeliveryTarget.name).order_by(DeliveryTarget.name)):
        for state in open_states:
            waiting.add(found.get((target, state), (0.0, 0.0))[0], target=target, state=state)
        oldest.add(max(0.0, *(found.get((target, state), (0.0, 0.0))[1] for state in open_states)), target=target)
        for state in (DeliveryState.DELIVERED, DeliveryState.FAILED):
            ended.add(sums.get(f"deliveries|{target}|{state}", 0.0), target=target, state=state)
        failures.add(sums.get(f"delivery_failures|{target}", 0.0), target=target)
        objects.add(sums.get(f"delivered_objects|{target}", 0.0), target=target)
    return [waiting, oldest, ended, failures, objects]


def _audit(heads: HeadWatch) -> Iterable[Metric]:
    head = Metric("fluoromap_audit_head", "gauge", "Number of the newest entry of the audit trail, with its hash.")
    if heads.published is not None:
        head.add(heads.published.entry, hash=heads.published.hash)
    breaks = Metric("fluoromap_audit_breaks_total", "counter", "Published hashes that left the audit trail.")
    breaks.add(heads.breaks)
    return [head, breaks]


def _disk() -> Iterable[Metric]:
    free = Metric("fluoromap_disk_free_bytes", "gauge", "Free space on the disk of the files.")
    free.add(disk.free_bytes())
    reserve = Metric("fluoromap_disk_reserve_bytes", "gauge", "Free space below which uploads are refused.")
    reserve.add(disk.reserve_bytes())
    total = Metric("fluoromap_disk_total_bytes", "gauge", "Size of the disk of the files.")
    total.add(disk.total_bytes())
    return [free, reserve, total]


def _requests(counts: RequestCounts, sign_in_failures: int) -> Iterable[Metric]:
    number = Metric("fluoromap_requests_total", "counter", "Requests of this process, by route and status.")
    for (method, route, status), count in list(counts.requests.items()):
        number.add(count, method=method, route=route, status=str(status))
    duration = Metric("fluoromap_request_seconds_total", "counter", "Duration of all requests of a route.")
    for (method, route), seconds in list(counts.seconds.items()):
        duration.add(seconds, method=method, route=route)
    failures = Metric("fluoromap_sign_in_failures_total", "counter", "Wrong tokens that this process was sent.")
    failures.add(sign_in_failures)
    return [number, duration, failures]
