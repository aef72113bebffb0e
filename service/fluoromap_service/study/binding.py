"""The runs of each mapping site, as a job would take them: the pairing rules applied to the rows of the store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, bindparam, select
from sqlalchemy.orm import Session

from fluoromap.matching.two_view import PARALLEL_BELOW_DEG
from fluoromap.reasons import Reason
from fluoromap_service.dicom.facts import HeaderWarning
from fluoromap_service.problem import not_found
from fluoromap_service.store.models import Site, Study
from fluoromap_service.study import pairing
from fluoromap_service.study.instances import StudyRun, runs_of
from fluoromap_service.study.pairing import SiteRuns


@dataclass(frozen=True, slots=True)
class BoundSite:
    """A site as a job would take it, or a pair of runs that nobody has named yet.

    Parameters
    ----------
    site : str or None
        None for a pair without a name.
    pair : int or None
        Number of such a pair, counted from 1 in the order of acquisition.
    lat_ms, lat_sd_ms : float or None
        Activation time and its standard deviation, where known.
    view_a, view_b : str or None
        SOP Instance UIDs; a is the run nearer to lateral unless somebody named the views.
    bound_by : str or None
        "explicit", "csv", "upload", "order" or "time"; None without runs.
    missing : tuple of str
        Of "site", "lat_ms", "view_a", "view_b", "gantry:view_a", "gantry:view_b".
    warnings : tuple of str
    doubts : tuple of Reason
        Why the positions of a pair that a job can use deserve less trust.
    unusable : Reason or None
        Why a job cannot use the pair although nothing is missing.
    angle_deg : float or None
        Between the two views' rays, folded to 0..90.
    """

    site: str | None
    lat_ms: float | None
    lat_sd_ms: float | None
    view_a: str | None
    view_b: str | None
    bound_by: str | None
    missing: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    unusable: Reason | None = None
    angle_deg: float | None = None
    pair: int | None = None
    doubts: tuple[Reason, ...] = ()

    @property
    def ready(self) -> bool:
        """Whether a job can use the site."""
        return not self.missing and self.unusable is None

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """The reasons why a job rejects this site; empty when it is ready."""
        found = [Reason.ONE_VIEW_ONLY] if {"view_a", "view_b"} & set(self.missing) else []
        if any(item.startswith("gantry:") for item in self.missing):
            found.append(Reason.NO_GEOMETRY)
        if "lat_ms" in self.missing:
            found.append(Reason.NO_ACTIVATION_TIME)
        if self.unusable is not None:
            found.append(self.unusable)
        return tuple(found)


@dataclass(frozen=True, slots=True)
class Binding:
    """A study's sites with their runs, in the order of first mention, and its pairs without a name by acquisition time."""

    sites: tuple[BoundSite, ...]
    pairs: tuple[BoundSite, ...]

    @property
    def by_row_order(self) -> tuple[BoundSite, ...]:
        """The sites whose runs are a guess by row order that nobody has confirmed."""
        return tuple(site for site in self.sites if site.bound_by == "order")


def rows_of(session: Session, study_id: str) -> list[Site]:
    """Return all rows of a study's sites in the order of first mention."""
    return list(session.scalars(select(Site).where(Site.study_id == study_id).order_by(Site.id)))


def binding_of(
    session: Session, study_id: str, *, also: str | None = None, runs: Sequence[StudyRun] | None = None
) -> Binding:
    """Return which runs belong to which site of a study.

    The rules are those of :mod:`pairing`. A site without runs and facts is left out, unless ``also`` is its name. A caller
    that has read the runs of the study gives them as ``runs``.
    """
    runs = runs_of(session, study_id) if runs is None else runs
    with_runs = {run.site for run in runs} | {also}
    rows = [
        row for row in session.execute(_SITES, {"study_id": study_id}) if row.name in with_runs or not _is_empty(row)
    ]
    gantries = [run.gantry for run in runs]
    values = [_run_value(run, gantry) for run, gantry in zip(runs, gantries, strict=True)]
    paired = pairing.pair_runs([_site_value(row) for row in rows], values)
    with_geometry = {run.uid for run, gantry in zip(runs, gantries, strict=True) if None not in gantry.values()}
    sites = tuple(_bound(row, paired.sites[row.name], with_geometry, paired.doubtful) for row in rows)
    pairs = tuple(
        _unnamed(number, pairing.lateral_first(*pair), with_geometry, paired.doubtful)
        for number, pair in enumerate(paired.unnamed, start=1)
    )
    return Binding(sites, pairs)


# Built once, and columns instead of whole rows: each request on a study reads its sites.
_SITES = (
    select(
        Site.name, Site.lat_ms, Site.lat_sd_ms, Site.csv_row, Site.explicit_a, Site.explicit_b, Site.csv_a, Site.csv_b,
        Site.ordered_a, Site.ordered_b,
    )
    .where(Site.study_id == bindparam("study_id"))
    .order_by(Site.id)
)  # fmt: skip


def _site_value(row: Row[*tuple[Any, ...]]) -> pairing.Site:
    return pairing.Site(
        name=row.name,
        csv_row=row.csv_row,
        explicit_a=row.explicit_a,
        explicit_b=row.explicit_b,
        csv_a=row.csv_a,
        csv_b=row.csv_b,
        ordered_a=row.ordered_a,
        ordered_b=row.ordered_b,
    )


def _run_value(run: StudyRun, gantry: Mapping[str, Any]) -> pairing.Run:
    primary, secondary = gantry["primary_deg"], gantry["secondary_deg"]
    return pairing.Run(
        uid=run.uid,
        arrival=run.arrival,
        direction=None if primary is None or secondary is None else pairing.central_ray(primary, secondary),
        acquired=run.facts.acquired,
        within_s=run.facts.acquired_within_s,
        zone_known=run.facts.acquired_zone_known,
        table_origin=run.facts.table_origin,
        series_number=run.facts.series_number,
        file_name=run.file_name,
        site=run.site,
        site_by=run.site_by,
        gantry_turned=HeaderWarning.POSITIONER_MOVED in run.facts.warnings,
        table_moved=HeaderWarning.TABLE_MOVED in run.facts.warnings,
    )


def _bound(row: Row[*tuple[Any, ...]], runs: SiteRuns, with_geometry: set[str], doubtful: frozenset[str]) -> BoundSite:
    missing = () if row.lat_ms is not None else ("lat_ms",)
    unusable, angle_deg = _pair_check(runs)
    doubts = _doubts(runs)
    guessed = [Reason.PAIRED_BY_ORDER] if runs.bound_by == "order" else []
    return BoundSite(
        site=row.name,
        lat_ms=row.lat_ms,
        lat_sd_ms=row.lat_sd_ms,
        view_a=runs.a.uid if runs.a else None,
        view_b=runs.b.uid if runs.b else None,
        bound_by=runs.bound_by,
        missing=(*missing, *_missing_runs(runs, with_geometry)),
        warnings=_warnings(*guessed, *_order_doubt(runs, doubtful), *doubts, unusable),
        unusable=unusable,
        angle_deg=angle_deg,
        doubts=doubts,
    )


def _unnamed(number: int, pair: pairing.Pair, with_geometry: set[str], doubtful: frozenset[str]) -> BoundSite:
    runs = SiteRuns(*pair)
    unusable, angle_deg = _pair_check(runs)
    doubts = _doubts(runs)
    return BoundSite(
        site=None,
        lat_ms=None,
        lat_sd_ms=None,
        view_a=pair[0].uid,
        view_b=pair[1].uid,
        bound_by="time",
        missing=("site", "lat_ms", *_missing_runs(runs, with_geometry)),
        warnings=_warnings(*_order_doubt(runs, doubtful), *doubts, unusable),
        unusable=unusable,
        angle_deg=angle_deg,
        pair=number,
        doubts=doubts,
    )


def _warnings(*reasons: Reason | None) -> tuple[str, ...]:
    return tuple(str(reason) for reason in reasons if reason is not None)


def _order_doubt(runs: SiteRuns, doubtful: frozenset[str]) -> tuple[Reason, ...]:
    return (Reason.ORDER_UNKNOWN,) if runs.a is not None and runs.a.uid in doubtful else ()


def _is_empty(row: Row[*tuple[Any, ...]]) -> bool:
    """Return whether nothing is known of a site but its name.

    Such a row stays when a table that named the site was replaced.
    """
    return all(fact is None for fact in (row.lat_ms, row.csv_row, row.explicit_a, row.explicit_b))


def _missing_runs(runs: SiteRuns, with_geometry: set[str]) -> list[str]:
    views = (("view_a", runs.a), ("view_b", runs.b))
    missing = [view for view, run in views if run is None]
    return missing + [f"gantry:{view}" for view, run in views if run is not None and run.uid not in with_geometry]


def _pair_check(runs: SiteRuns) -> tuple[Reason | None, float | None]:
    """Return why a job cannot use a pair, and the rays' angle."""
    if runs.a is None or runs.b is None:
        return None, None
    angle_deg = pairing.view_angle_deg(runs.a, runs.b)
    if runs.a.gantry_turned or runs.b.gantry_turned:
        return Reason.GANTRY_TURNED, angle_deg
    if angle_deg is not None and angle_deg < PARALLEL_BELOW_DEG:
        return Reason.VIEWS_PARALLEL, angle_deg
    return None, angle_deg


def _doubts(runs: SiteRuns) -> tuple[Reason, ...]:
    """Return why the positions of a usable pair deserve less trust."""
    if runs.a is None or runs.b is None:
        return ()
    moved = runs.a.table_moved or runs.b.table_moved or not pairing.tables_comparable(runs.a, runs.b)
    return (Reason.TABLE_MOVED,) if moved else ()


def site_of(session: Session, study: Study, name: str, *, also_empty: bool = False) -> BoundSite:
    """Return one site of a study.

    ``also_empty``: even when nothing is known of it but its name.

    Raises
    ------
    Problem
        404 when there is none of that name.
    """
    for site in binding_of(session, study.id, also=name if also_empty else None).sites:
        if site.site == name:
            return site
    raise not_found("site in this study")


def views_of(binding: Binding) -> dict[str, tuple[BoundSite, str]]:
    """Return site and view of each bound run, by SOP Instance UID.

    The view is "a" or "b". The site may be a pair without a name.
    """
    found: dict[str, tuple[BoundSite, str]] = {}
    for site in (*binding.sites, *binding.pairs):
        for view, uid in (("a", site.view_a), ("b", site.view_b)):
            if uid is not None:
                found[uid] = (site, view)
    return found
