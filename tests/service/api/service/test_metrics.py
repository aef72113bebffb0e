"""The metrics: well formed, true, without patient data, and equal to those of dashboard and alerts."""

from __future__ import annotations

import json
import re
from pathlib import Path

import yaml
from fastapi.testclient import TestClient
from finished_study import make_study
from sqlalchemy import update

from fluoromap_service.jobs import job_life
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import writing
from fluoromap_service.store.models import StageRow

DEPLOY = Path(__file__).parents[4] / "deploy"
SAMPLE = re.compile(r'^([a-z_]+)(?:\{((?:[a-z]+="[^"\n]*",?)*)\})? (\S+)$')
SUFFIXES = re.compile(r"_(bucket|sum|count)$")


def _samples(service: TestClient) -> dict[str, float]:
    answer = service.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    found, types = {}, {}
    for line in answer.text.splitlines():
        if line.startswith("# TYPE"):
            _, _, name, kind = line.split(" ")
            types[name] = kind
        elif not line.startswith("#"):
            match = SAMPLE.fullmatch(line)
            assert match, line
            assert match[1] in types or SUFFIXES.sub("", match[1]) in types, line
            key = f"{match[1]}{{{match[2]}}}" if match[2] else match[1]
            assert key not in found, line
            found[key] = float(match[3])
    return found


def test_queue_durations_and_failures(service: TestClient) -> None:
    study = make_study()
    with writing() as session:
        session.execute(update(StageRow).values(ready_since=db_now() - 100))
    before = _samples(service)
    assert before['fluoromap_jobs{state="queued"}'] == 1
    assert before['fluoromap_stages{stage="segment",state="ready"}'] == 4
    assert 100 <= before["fluoromap_oldest_ready_stage_seconds"] < 200
    study.finish()
    after = _samples(service)
    assert after['fluoromap_jobs{state="queued"}'] == after["fluoromap_oldest_ready_stage_seconds"] == 0
    assert after['fluoromap_stages_total{stage="segment",state="done"}'] == 4
    assert after['fluoromap_stage_seconds_count{stage="segment"}'] == 4
    assert after['fluoromap_stage_seconds_bucket{stage="segment",le="+Inf"}'] == 4
    assert after['fluoromap_jobs_total{state="succeeded"}'] == 1
    assert after["fluoromap_disk_free_bytes"] > 0
    assert after['fluoromap_requests_total{method="GET",route="/metrics",status="200"}'] == 1


def test_lost_workers_and_failed_stages_are_counted(service: TestClient) -> None:
    study = make_study()
    study.fail("segment", study.uids["S01", "a"])
    with study.claimed("segment", study.uids["S01", "b"]) as (session, _):
        session.execute(update(StageRow).where(StageRow.state == "running").values(lease_until=db_now() - 1))
    with writing() as session:
        assert job_life.reap(session) == 1
    samples = _samples(service)
    assert samples['fluoromap_stages_total{stage="segment",state="failed"}'] == 1
    assert samples["fluoromap_leases_reaped_total"] == 1


def _existing(service: TestClient) -> set[str]:
    return set(re.findall(r"^# TYPE (\S+)", service.get("/metrics").text, re.M))


def test_dashboard_and_alerts_use_existing_metrics(service: TestClient) -> None:
    dashboard = json.loads((DEPLOY / "grafana" / "fluoromap.json").read_text())
    rules = yaml.safe_load((DEPLOY / "prometheus" / "alerts.yml").read_text())
    expressions = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    shown = {SUFFIXES.sub("", name) for text in expressions for name in re.findall(r"fluoromap_[a-z_]+", text)}
    assert shown == _existing(service)
    alerts = [rule for group in rules["groups"] for rule in group["rules"]]
    assert len({rule["alert"] for rule in alerts}) == len(alerts) >= 8
    for rule in alerts:
        assert rule["annotations"]["summary"].endswith(".")
        assert rule["labels"]["severity"] in ("warning", "critical")
        assert set(re.findall(r"fluoromap_[a-z_]+", rule["expr"])) <= _existing(service)


def test_page_of_operations_lists_every_metric(service: TestClient) -> None:
    page = (DEPLOY.parent / "docs" / "operations.md").read_text()
    rows = [name for row in re.findall(r"^\| (`fluoromap_.*?) \|", page, re.M) for name in re.findall(r"`(\w+)`", row)]
    assert sorted(rows) == sorted(_existing(service))
