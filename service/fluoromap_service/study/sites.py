"""Changes of mapping sites: their names, their activation times and their runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import insert, select
from sqlalchemy.orm import Session

from fluoromap_service.problem import Problem
from fluoromap_service.store.models import Site, Study
from fluoromap_service.study.binding import BoundSite, binding_of, rows_of
from fluoromap_service.study.instances import link_of, runs_of


@dataclass(frozen=True, slots=True)
class ActivationTime:
    """One row of an activation-time table."""

    row: int
    site: str
    lat_ms: float
    view_a: str | None = None
    view_b: str | None = None


def mention(session: Session, study_id: str, name: str) -> Site:
    """Return the row of a site; add it at the first mention.

    Raises
    ------
    Problem
        422 when the text cannot be a name.
    """
    _check_name(name)
    row = session.scalar(select(Site).where(Site.study_id == study_id, Site.name == name))
    if row is None:
        row = Site(study_id=study_id, name=name)
        session.add(row)
        session.flush()
    return row


def _check_name(name: str) -> None:
    if not is_site_name(name):
        raise Problem(
            422,
            "invalid_site",
            "A site's name has 1 to 64 characters, no slash, no control character and no space at its ends.",
            [("site", "not usable as a name")],
        )


def is_site_name(name: str) -> bool:
    """Return whether a text can name a site in addresses and file names."""
    return (
        re.fullmatch(r"[^\x00-\x1f\x7f/\\]{1,64}", name) is not None
        and name == name.strip()
        and name not in (".", "..")
    )


def put_table(session: Session, study: Study, table: Sequence[ActivationTime]) -> list[str]:
    """Replace the study's activation-time table.

    Times from PUT or from an electrogram stay, unless the table names their site.

    Returns
    -------
    list of str
        Sites of the table that have no run, or not the run that the table names.
    """
    _add_sites(session, study.id, [entry.site for entry in table])
    rows = {row.name: row for row in rows_of(session, study.id)}
    for row in rows.values():
        row.csv_row = row.csv_a = row.csv_b = row.ordered_a = row.ordered_b = None
        if row.lat_by == "csv":
            row.lat_ms = row.lat_sd_ms = row.lat_by = None
    for entry in table:
        row = rows[entry.site]
        row.csv_row, row.csv_a, row.csv_b = entry.row, entry.view_a, entry.view_b
        row.lat_ms, row.lat_sd_ms, row.lat_by = entry.lat_ms, None, "csv"
    session.flush()
    bound = {site.site: site for site in binding_of(session, study.id).sites}
    return [entry.site for entry in table if not _has_its_runs(entry, bound[entry.site])]


def _add_sites(session: Session, study_id: str, names: Sequence[str]) -> None:
    """Add the sites that the study lacks, in this order."""
    for name in names:
        _check_name(name)
    known = set(session.scalars(select(Site.name).where(Site.study_id == study_id)))
    added = [{"study_id": study_id, "name": name} for name in dict.fromkeys(names) if name not in known]
    if added:
        session.execute(insert(Site), added)


def _has_its_runs(entry: ActivationTime, site: BoundSite) -> bool:
    """Return whether a row of the table has the runs it names.

    A row that names none needs any run.
    """
    if entry.view_a is None and entry.view_b is None:
        return site.view_a is not None or site.view_b is not None
    return (entry.view_a is None or site.view_a is not None) and (entry.view_b is None or site.view_b is not None)


def confirm_order(session: Session, study: Study, name: str, views: dict[str, str | None]) -> None:
    """Bind a site by hand to the runs that row order gave it.

    Nothing happens when ``views`` asks for other runs. The other sites keep their runs by row order, with the warning:
    only this one was looked at.
    """
    guessed = {site.site: site for site in binding_of(session, study.id).by_row_order}
    confirmed = guessed.get(name)
    if confirmed is None or views.items() - {("view_a", confirmed.view_a), ("view_b", confirmed.view_b)}:
        return
    for row in rows_of(session, study.id):
        if row.name == name:
            row.explicit_a, row.explicit_b = confirmed.view_a, confirmed.view_b
            row.ordered_a = row.ordered_b = None
        elif row.name in guessed:
            row.ordered_a, row.ordered_b = guessed[row.name].view_a, guessed[row.name].view_b
    session.flush()


def put_views(session: Session, study: Study, name: str, views: dict[str, str | None]) -> None:
    """Bind runs to a site by hand.

    A run leaves the site that it was in.

    Parameters
    ----------
    session : Session
    study : Study
    name : str
    views : dict
        SOP Instance UIDs under "view_a" and "view_b"; None frees a view.

    Raises
    ------
    Problem
        422 when a run is not in the study or would be both views.
    """
    uids = {run.uid for run in runs_of(session, study.id)}
    row = mention(session, study.id, name)
    after = {"view_a": row.explicit_a, "view_b": row.explicit_b, **views}
    errors = [
        (view, "there is no such instance in this study") for view, uid in views.items() if uid and uid not in uids
    ]
    if after["view_a"] is not None and after["view_a"] == after["view_b"]:
        errors.append(("view_b", "the two views must be two different runs"))
    if errors:
        raise Problem(422, "invalid_binding", "The site cannot have these runs; see 'errors' for each view.", errors)
    for other in rows_of(session, study.id):
        if other is not row:
            other.explicit_a = None if other.explicit_a in views.values() else other.explicit_a
            other.explicit_b = None if other.explicit_b in views.values() else other.explicit_b
    row.explicit_a, row.explicit_b = after["view_a"], after["view_b"]
    session.flush()


def move_run(session: Session, study: Study, uid: str, site: str | None) -> None:
    """Put a run into a site by hand.

    None takes it out of every site, and the rules apply again.

    Raises
    ------
    Problem
        404 when the study has no such run.
    """
    for row in rows_of(session, study.id):
        row.explicit_a = None if row.explicit_a == uid else row.explicit_a
        row.explicit_b = None if row.explicit_b == uid else row.explicit_b
    if site is not None:
        mention(session, study.id, site)
    link = link_of(session, study.id, uid)
    link.site, link.site_by = site, None if site is None else "explicit"
    session.flush()
