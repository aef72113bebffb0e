"""Mapping sites: activation times, and the runs bound to them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap.reasons import Reason
from fluoromap_service.problem import Problem
from fluoromap_service.store.models import Job, Site, Study
from fluoromap_service.study.instances import StudyRun, effective_gantry, ray_angle_deg, runs_of
from fluoromap_service.study.pairing import PARALLEL_ANGLE_DEG, ROUNDING_DEG, Slots, bind, table_moved


@dataclass(frozen=True, slots=True)
class BoundSite:
    """A site as a job would take it.

    Parameters
    ----------
    site : str
    lat_ms, lat_sd_ms : float or None
        Activation time and its standard deviation where one was told.
    view_a, view_b : str or None
        SOP Instance UIDs; a is the run nearer to lateral unless someone said otherwise.
    bound_by : str or None
        "explicit", "csv", "upload", "order" or "time"; None without runs.
    missing : tuple of str
        Of "lat_ms", "view_a", "view_b", "gantry:view_a", "gantry:view_b".
    warnings : tuple of str
    refused : Reason or None
        Why the pair cannot be used although nothing is missing.
    angle_deg : float or None
        Between the two views' rays, folded to 0..90.
    """

    site: str
    lat_ms: float | None
    lat_sd_ms: float | None
    view_a: str | None
    view_b: str | None
    bound_by: str | None
    missing: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    refused: Reason | None = None
    angle_deg: float | None = None

    @property
    def ready(self) -> bool:
        return not self.missing and self.refused is None

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why a job will reject this site; empty when it is ready."""
        found = [Reason.ONE_VIEW_ONLY] if {"view_a", "view_b"} & set(self.missing) else []
        if any(item.startswith("gantry:") for item in self.missing):
            found.append(Reason.NO_GEOMETRY)
        if "lat_ms" in self.missing:
            found.append(Reason.NO_ACTIVATION_TIME)
        if self.refused is not None:
            found.append(self.refused)
        return tuple(found)


@dataclass(frozen=True, slots=True)
class ActivationTime:
    """One row of an activation-time table."""

    row: int
    site: str
    lat_ms: float
    view_a: str | None = None
    view_b: str | None = None


def rows_of(session: Session, study_id: str) -> list[Site]:
    """All rows of a study's sites in the order of first mention."""
    return list(session.scalars(select(Site).where(Site.study_id == study_id).order_by(Site.id)))


def resolve(session: Session, study: Study) -> list[BoundSite]:
    """The study's sites with their runs, in the order of first mention; pairs without a name yet are left out."""
    rows = rows_of(session, study.id)
    binding = bind(rows, runs_of(session, study.id))
    return [_bound(row, binding.slots[row.name]) for row in rows if _stands(row, binding.slots[row.name])]


def settle(session: Session, study: Study) -> None:
    """Pair runs by acquisition time and name the pairs; call it in every transaction that changes the study's runs.

    A name is given at the first pairing and stays with its run. Which run is the other one may still change while runs
    arrive out of order, until the site has an activation time or a job was made: from then on the pair is for good.
    """
    rows, runs = rows_of(session, study.id), runs_of(session, study.id)
    has_job = session.scalar(select(Job.id).where(Job.study_id == study.id).limit(1)) is not None
    loose = [row for row in rows if row.paired_a and row.csv_row is None and row.lat_ms is None and not has_job]
    before = {row: {row.paired_a, row.paired_b} for row in loose}
    for row in loose:
        row.paired_a = row.paired_b = None
    known = {row.name for row in rows} | {run.link.site for run in runs}
    numbers = itertools.count(1)
    for first, second in bind(rows, runs).fresh:
        pair = {first.uid, second.uid}
        owner = max(before, key=lambda row: len(before[row] & pair), default=None)
        if owner is None or not before[owner] & pair:
            name = next(name for number in numbers if (name := f"S{number:02d}") not in known)
            owner = Site(study_id=study.id, name=name)
            session.add(owner)
        else:
            del before[owner]
        owner.paired_a, owner.paired_b = first.uid, second.uid
    for row in before:
        if row.explicit_a is None and row.explicit_b is None:
            session.delete(row)
    session.flush()


def _bound(row: Site, slot: Slots) -> BoundSite:
    missing = [] if row.lat_ms is not None else ["lat_ms"]
    missing += [view for view, run in (("view_a", slot.a), ("view_b", slot.b)) if run is None]
    for view, run in (("view_a", slot.a), ("view_b", slot.b)):
        if run is not None and effective_gantry(run.facts, run.link.gantry) is None:
            missing.append(f"gantry:{view}")
    warnings: list[str] = []
    refused: Reason | None = None
    angle: float | None = None
    if slot.a is not None and slot.b is not None:
        angle = ray_angle_deg(slot.a, slot.b)
        if angle is not None and angle < PARALLEL_ANGLE_DEG - ROUNDING_DEG:
            refused = Reason.VIEWS_PARALLEL
        if table_moved(slot.a, slot.b):
            warnings.append("table_moved")
            refused = Reason.TABLE_MOVED
    if refused is not None and str(refused) not in warnings:
        warnings.append(str(refused))
    return BoundSite(
        site=row.name,
        lat_ms=row.lat_ms,
        lat_sd_ms=row.lat_sd_ms,
        view_a=slot.a.uid if slot.a else None,
        view_b=slot.b.uid if slot.b else None,
        bound_by=slot.by,
        missing=tuple(missing),
        warnings=tuple(warnings),
        refused=refused,
        angle_deg=angle,
    )


def _stands(row: Site, slot: Slots) -> bool:
    """Whether there is anything to tell of a site; a pair that others took over leaves an empty row behind."""
    told = (row.lat_ms, row.csv_row, row.explicit_a, row.explicit_b)
    return bool(slot.runs) or any(value is not None for value in told)


def one(session: Session, study: Study, name: str) -> BoundSite:
    """One site of a study.

    Raises
    ------
    Problem
        404 when there is none of that name.
    """
    for site in resolve(session, study):
        if site.site == name:
            return site
    raise Problem(404, "not_found", "There is no such site in this study.")


def as_it_stands(session: Session, study: Study, name: str) -> BoundSite:
    """As :func:`one` for a site that may have been emptied just now."""
    row = mention(session, study.id, name)
    return _bound(row, bind(rows_of(session, study.id), runs_of(session, study.id)).slots[name])


def mention(session: Session, study_id: str, name: str) -> Site:
    """The row of a site, made when it is mentioned for the first time.

    Raises
    ------
    Problem
        422 when the name cannot be one.
    """
    if not is_site_name(name):
        raise Problem(
            422,
            "invalid_site",
            "A site's name has 1 to 64 characters, no slash, no control character and no space at its ends.",
            [("site", "not usable as a name")],
        )
    row = session.scalar(select(Site).where(Site.study_id == study_id, Site.name == name))
    if row is None:
        row = Site(study_id=study_id, name=name)
        session.add(row)
        session.flush()
    return row


def is_site_name(name: str) -> bool:
    """Whether a text can name a site: it stands in addresses and file names."""
    return (
        re.fullmatch(r"[^\x00-\x1f\x7f/\\]{1,64}", name) is not None
        and name == name.strip()
        and name not in (".", "..")
    )


def put_table(session: Session, study: Study, table: Sequence[ActivationTime]) -> list[str]:
    """Replace the study's activation-time table; times told by PUT or electrogram stay unless the table names their site.

    Returns
    -------
    list of str
        Sites of the table that no run is bound to, or not the run that the table names.
    """
    for row in rows_of(session, study.id):
        row.csv_row = row.csv_a = row.csv_b = None
        if row.lat_by == "csv":
            row.lat_ms = row.lat_sd_ms = row.lat_by = None
    for entry in table:
        row = mention(session, study.id, entry.site)
        row.csv_row, row.csv_a, row.csv_b = entry.row, entry.view_a, entry.view_b
        row.lat_ms, row.lat_sd_ms, row.lat_by = entry.lat_ms, None, "csv"
    session.flush()
    bound = {site.site: site for site in resolve(session, study)}
    return [entry.site for entry in table if not _kept(entry, bound[entry.site])]


def _kept(entry: ActivationTime, site: BoundSite) -> bool:
    """Whether a row of the table found its runs: those it names, or else any."""
    if entry.view_a is None and entry.view_b is None:
        return site.view_a is not None or site.view_b is not None
    return (entry.view_a is None or site.view_a is not None) and (entry.view_b is None or site.view_b is not None)


def put_views(session: Session, study: Study, name: str, views: dict[str, str | None]) -> None:
    """Bind runs to a site by hand; keys "view_a", "view_b", None sets a view free. A run leaves the site it was in.

    Raises
    ------
    Problem
        422 when a run is not in the study or would be both views.
    """
    known = {run.uid: run for run in runs_of(session, study.id)}
    row = mention(session, study.id, name)
    after = {"view_a": row.explicit_a, "view_b": row.explicit_b, **views}
    errors = [
        (view, "there is no such instance in this study") for view, uid in views.items() if uid and uid not in known
    ]
    if after["view_a"] is not None and after["view_a"] == after["view_b"]:
        errors.append(("view_b", "the two views must be two different runs"))
    if errors:
        raise Problem(422, "invalid_binding", "These runs cannot be bound to the site.", errors)
    for other in rows_of(session, study.id):
        if other is not row:
            other.explicit_a = None if other.explicit_a in views.values() else other.explicit_a
            other.explicit_b = None if other.explicit_b in views.values() else other.explicit_b
    row.explicit_a, row.explicit_b = after["view_a"], after["view_b"]
    session.flush()


def move_run(session: Session, study: Study, run: StudyRun, site: str | None) -> None:
    """Put a run into a site by hand, or take it out of every one it was put into (then the rules apply again)."""
    for row in rows_of(session, study.id):
        row.explicit_a = None if row.explicit_a == run.uid else row.explicit_a
        row.explicit_b = None if row.explicit_b == run.uid else row.explicit_b
    if site is not None:
        mention(session, study.id, site)
    run.link.site, run.link.site_by = site, None if site is None else "explicit"
    session.flush()


def views_of(bound: Sequence[BoundSite]) -> dict[str, tuple[BoundSite, str]]:
    """SOP Instance UID -> the site it is bound to and the view it is there."""
    found: dict[str, tuple[BoundSite, str]] = {}
    for site in bound:
        for view, uid in (("a", site.view_a), ("b", site.view_b)):
            if uid is not None:
                found[uid] = (site, view)
    return found
