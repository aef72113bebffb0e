"""Rules that start jobs: a job when everything is there, none on half a study, and one only."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from small_runs import run_uid, small_run
from sqlalchemy import select, text, update

from fluoromap_service.dicom.indexed_header import read_run
from fluoromap_service.jobs.rule_watch import RuleWatch
from fluoromap_service.jobs.start_rules import StartRule, read_rules
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings
from fluoromap_service.store import audit
from fluoromap_service.store.audit import Act
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Job, Site, StudyInstance
from fluoromap_service.study.arrivals import add_arrival

PAGE = Path(__file__).parents[3] / "docs" / "pacs.md"

Arrive = Callable[..., None]


@pytest.fixture(autouse=True)
def no_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the started jobs queued."""
    monkeypatch.setattr("fluoromap_service.jobs.queue.publish_due", lambda: 0)


@pytest.fixture
def arrive(data_dir: Path, tmp_path: Path) -> Arrive:
    """Let runs arrive as the listener does; run 1 and 2 are the views of site 1, and so on."""

    def add(*numbers: int, **header: Any) -> None:
        for number in numbers:
            path = tmp_path / f"{number}.dcm"
            content = small_run(tmp_path, number, 90.0 * (number % 2), **header)
            path.write_bytes(content)
            with writing() as session:
                sha256 = hashlib.sha256(content).hexdigest()
                add_arrival(session, path, read_run(path), sha256, Act("DICOM XA_ROOM_1", "C-STORE"))

    return add


def set_times(count: int, *, by_table: bool = True) -> None:
    """Give the first sites their times and the runs that belong to them."""
    with writing() as session:
        study = session.scalars(select(StudyInstance.study_id)).first()
        assert study is not None
        for number in range(1, count + 1):
            runs = {"csv_a": run_uid(2 * number - 1), "csv_b": run_uid(2 * number)}
            row = {"csv_row": number, "lat_by": "csv", **runs} if by_table else {"lat_by": "explicit"}
            session.add(Site(study_id=study, name=f"S{number}", lat_ms=10.0 * number, **row))
        audit.append(session, [Act("tester", "PUT /v1/studies/{study_id}/activation-times", study)])


def jobs() -> int:
    with reading() as session:
        return len(session.scalars(select(Job.id)).all())


def test_table_says_when_a_study_is_whole(arrive: Arrive) -> None:
    watch = RuleWatch([StartRule(name="map")])
    assert watch.look() == 0
    arrive(1, 2)
    assert watch.look() == 0
    set_times(2)
    assert watch.look() == 0
    arrive(3)
    assert watch.look() == 0
    arrive(4)
    assert watch.look() == 1
    assert watch.look() == 0
    with reading() as session:
        (job,) = session.scalars(select(Job)).all()
        assert sorted(site["site"] for site in job.snapshot["sites"]) == ["S1", "S2"]
        acts = [(act.who, act.what, act.job) for act in audit.entries(session) if act.job]
    assert acts == [("rule map", "start job", job.id)]


def test_number_of_sites_says_when_a_study_is_whole(arrive: Arrive) -> None:
    watch = RuleWatch([StartRule(name="map", sites=2)])
    arrive(1, 2)
    set_times(1)
    assert watch.look() == 0
    arrive(3, 4)
    assert watch.look() == 0
    with writing() as session:
        study = session.scalars(select(StudyInstance.study_id)).first()
        session.add(
            Site(study_id=study, name="S2", lat_ms=1.0, lat_by="explicit", explicit_a=run_uid(3), explicit_b=run_uid(4))
        )
        audit.append(session, [Act("tester", "PUT /v1/studies/{study_id}/sites/{site}", study)])
    assert watch.look() == 1


def test_more_runs_for_each_site_are_waited_for(arrive: Arrive) -> None:
    watch = RuleWatch([StartRule(name="map", sites=1, runs_per_site=3)])
    arrive(1, 2)
    set_times(1)
    assert watch.look() == 0
    arrive(3)
    assert watch.look() == 1


@pytest.mark.parametrize(("rule", "started"), [({}, 0), ({"geometry": False}, 1)])
def test_missing_geometry(arrive: Arrive, rule: dict[str, Any], started: int) -> None:
    arrive(1, 2, 3, 4)
    set_times(2)
    with writing() as session:
        session.execute(
            text(
                "UPDATE instance SET facts = json_set(facts, '$.source_detector_mm', NULL) WHERE sop_instance_uid = :uid"
            ),
            {"uid": run_uid(4)},
        )
    assert RuleWatch([StartRule(name="map", **rule)]).look() == started


@pytest.mark.parametrize(("rule", "started"), [({}, 0), ({"activation_times": False}, 1)])
def test_missing_activation_time(arrive: Arrive, rule: dict[str, Any], started: int) -> None:
    arrive(1, 2, 3, 4)
    set_times(2)
    with writing() as session:
        session.execute(update(Site).where(Site.name == "S2").values(lat_ms=None))
    assert RuleWatch([StartRule(name="map", **rule)]).look() == started


def test_quiet_time_starts_with_the_ready_sites(arrive: Arrive) -> None:
    watch = RuleWatch([StartRule(name="map", quiet_seconds=600)])
    arrive(1, 2, 3)
    set_times(2)
    assert watch.look() == 0
    _let_pass(590)
    assert watch.look() == 0
    _let_pass(20)
    assert watch.look() == 1
    with reading() as session:
        snapshot = session.scalars(select(Job.snapshot)).one()
    assert [site["site"] for site in snapshot["sites"]] == ["S1"]


def test_reading_does_not_end_a_silence_and_writing_does(arrive: Arrive) -> None:
    watch = RuleWatch([StartRule(name="map", quiet_seconds=600)])
    arrive(1, 2, 3)
    set_times(2)
    _let_pass(590)
    with writing() as session:
        study = session.scalars(select(StudyInstance.study_id)).first()
        audit.append(session, [Act("tester", "PATCH /v1/studies/{study_id}", study)])
    _let_pass(20)
    assert watch.look() == 0
    with writing() as session:
        audit.append(session, [Act("tester", "GET /v1/studies/{study_id}", study)])
    _let_pass(580)
    with writing() as session:
        audit.append(session, [Act("tester", "GET /v1/studies/{study_id}", study)])
    assert watch.look() == 1


def test_study_with_a_job_is_left_alone(arrive: Arrive) -> None:
    arrive(1, 2)
    set_times(1)
    assert RuleWatch([StartRule(name="map")]).look() == 1
    arrive(3, 4)
    assert RuleWatch([StartRule(name="map"), StartRule(name="other", quiet_seconds=1e-6)]).look() == 0


def test_services_that_look_at_once_start_one_job(arrive: Arrive) -> None:
    arrive(1, 2)
    set_times(1)
    with ThreadPoolExecutor(4) as threads:
        started = list(threads.map(lambda _: RuleWatch([StartRule(name="map")]).look(), range(4)))
    assert sum(started) == jobs() == 1


def test_studies_of_people_are_left_alone(arrive: Arrive) -> None:
    arrive(1, 2)
    set_times(1)
    with writing() as session:
        session.execute(text("UPDATE study SET study_instance_uid = NULL"))
    assert RuleWatch([StartRule(name="map")]).look() == 0


@pytest.fixture
def read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], tuple[StartRule, ...]]]:
    """Return a function that reads the rules of a configuration file with a text."""
    file = tmp_path / "fluoromap.toml"
    monkeypatch.setenv("FLUOROMAP_CONFIG", str(file))
    settings.cache_clear()

    def read_text(content: str) -> tuple[StartRule, ...]:
        file.write_text(content)
        return read_rules()

    yield read_text
    settings.cache_clear()


def test_example_of_the_page_is_a_rule(read: Callable[[str], tuple[StartRule, ...]]) -> None:
    example = next(part for part in PAGE.read_text().split("```toml\n") if "[rules." in part).split("```")[0]
    for content in (example, example.replace("\n# ", "\n")):
        (rule,) = read(content)
        assert (rule.name, rule.sites) == ("map", 8)
    assert (rule.quiet_seconds, rule.pipeline.fuser.name) == (600, "convex-hull")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("rules = 3\n", "[rules.NAME]"),
        ("[rules.map]\nsite = 3\n", "rules.map.site"),
        ("[rules.map]\nruns_per_site = 1\n", "rules.map.runs_per_site"),
        ('[rules.map.pipeline.fuser]\nname = "none"\n', "no such plugin"),
        ("[rule.map]\n", "unknown tables: rule"),
    ],
)
def test_mistakes_have_a_sentence(read: Callable[[str], tuple[StartRule, ...]], content: str, reason: str) -> None:
    with pytest.raises(Problem, match=re.escape(reason)):
        read(content)


def _let_pass(seconds: float) -> None:
    """Move the acts of the audit trail into the past."""
    with writing() as session:
        session.execute(text("DROP TRIGGER IF EXISTS audit_no_UPDATE"))
        session.execute(text("UPDATE audit SET at = at - :seconds"), {"seconds": seconds})
