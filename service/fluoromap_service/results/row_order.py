"""Sites of a job whose runs are a guess by row order that nobody has confirmed."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap.reasons import Reason
from fluoromap_service.store.models import Job
from fluoromap_service.study.binding import binding_of


def sites_by_row_order(session: Session, job: Job) -> tuple[str, ...]:
    """Return the job's sites with guessed runs; a confirmation after the job counts too."""
    # The database picks the sites: the whole snapshot is long, and this runs with every look at a job.
    sites = session.scalar(select(Job.snapshot["sites"]).where(Job.id == job.id)) or ()
    guessed = {site["site"]: (site["view_a"], site["view_b"]) for site in sites if site.get("bound_by") == "order"}
    if not guessed:
        return ()
    confirmed = {
        site.site: (site.view_a, site.view_b)
        for site in binding_of(session, job.study_id).sites
        if site.bound_by not in ("order", None)
    }
    return tuple(name for name, views in guessed.items() if confirmed.get(name) != views)


def warnings_of(session: Session, job: Job) -> tuple[Reason, ...]:
    """Return the warnings that a job and all its results carry."""
    return (Reason.PAIRED_BY_ORDER,) if sites_by_row_order(session, job) else ()
