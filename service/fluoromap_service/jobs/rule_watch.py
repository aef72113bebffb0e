"""The start of jobs by rules: studies from a DICOM door are looked at again whenever somebody did something to them."""

from __future__ import annotations

from collections.abc import Sequence

import structlog
from sqlalchemy import Float, case, exists, func, select
from sqlalchemy.orm import Session

from fluoromap_service.jobs import job_life, queue
from fluoromap_service.jobs.start_rules import StartRule
from fluoromap_service.problem import Problem
from fluoromap_service.store import audit
from fluoromap_service.store.audit import Act
from fluoromap_service.store.clock import db_now
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import AuditEntry, Job, Study
from fluoromap_service.study import studies
from fluoromap_service.study.freeze import freeze

LONGEST_WAIT_DAYS = 30.0
"""Age from which a study without a job is left to people."""

log = structlog.get_logger(__name__)


class RuleWatch:
    """Looks for studies that fulfil a rule. Any number of processes may do so.

    Parameters
    ----------
    rules : sequence of StartRule
        Of several rules that a study fulfils, the first counts.
    """

    def __init__(self, rules: Sequence[StartRule]) -> None:
        self._rules = rules
        # Study -> newest act on it when its rules were read, and when a start after a silence was tried.
        self._examined: dict[str, int] = {}
        self._tried: dict[str, int] = {}

    def look(self) -> int:
        """Start the jobs of the studies that fulfil a rule, and return how many.

        A rule starts at most one job of a study, and none when the study has a job already.
        """
        with reading() as session:
            candidates = _candidates(session)
        started = 0
        for study, newest_act, silence_seconds in candidates:
            changed = self._examined.get(study) != newest_act
            whole = next((rule for rule in self._rules if changed and _holds(rule, study)), None)
            silent = next((rule for rule in self._rules if rule.allows_silence_of(silence_seconds)), None)
            if whole is not None:
                started += _start(study, whole, whole=True)
            elif silent is not None and self._tried.get(study) != newest_act:
                started += _start(study, silent, whole=False)
                self._tried[study] = newest_act
            self._examined[study] = newest_act
        known = {study for study, _, _ in candidates}
        self._examined = {study: act for study, act in self._examined.items() if study in known}
        self._tried = {study: act for study, act in self._tried.items() if study in known}
        if started:
            queue.publish_due()
        return started


def _candidates(session: Session) -> list[tuple[str, int, float]]:
    """Return the studies that wait for a job.

    Each comes with the id of the newest act on it, and the seconds since the last act that was more than reading.
    """
    changed = func.max(case((AuditEntry.what.not_like("GET %"), AuditEntry.at)), type_=Float())
    query = (
        select(Study.id, func.max(AuditEntry.id), db_now() - func.coalesce(changed, Study.created))
        .join(AuditEntry, AuditEntry.study == Study.id)
        .where(
            Study.study_instance_uid.is_not(None),
            Study.created > db_now() - LONGEST_WAIT_DAYS * 86400.0,
            ~exists().where(Job.study_id == Study.id),
        )
        .group_by(Study.id, Study.created)
        .order_by(Study.created)
    )
    return [(study, newest, silence) for study, newest, silence in session.execute(query)]


def _holds(rule: StartRule, study: str) -> bool:
    with reading() as session:
        return rule.holds(session, study)


def _start(study_id: str, rule: StartRule, *, whole: bool) -> bool:
    try:
        with writing() as session:
            study = studies.lock(session, study_id)
            # Under the lock nothing arrives, and no other process starts a job.
            if session.scalar(select(exists().where(Job.study_id == study_id))):
                return False
            if whole and not rule.holds(session, study_id):
                return False
            job = job_life.create(session, study_id, freeze(session, study, rule.pipeline, rule.view))
            audit.append(session, [Act(f"rule {rule.name}", "start job", study_id, job.id)])
    except Problem as problem:
        log.info("rule_cannot_start", rule=rule.name, study=study_id, code=problem.code)
        return False
    log.info("rule_started_job", rule=rule.name, study=study_id, job=job.id, whole=whole)
    return True
