"""The rules that join two runs to a mapping site, as pure functions on plain values.

1. Runs set by PUT or PATCH.
2. Runs that the activation-time table names.
3. The site given at upload.
4. Runs that follow each other in acquisition time, with views 30 degrees or more apart, make a pair without a name.
5. Row order: when nobody has named a run or a pair, and the table has as many rows as there are pairs, the pairs in the
   order of time take the rows in their order. The result says so (``bound_by`` is "order"), because it is a guess.

A name comes from a person, an upload or a table. No rule invents one.
"""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from fluoromap.geometry import direction_angle_deg, view_axes
from fluoromap_service.dicom.facts import TableOrigin
from fluoromap_service.store.names import normal_name

PAIRING_ANGLE_DEG = 30.0
"""Smallest angle between the views of two runs that acquisition time pairs."""
ROUNDING_DEG = 1e-6
"""Tolerance of the comparison of angles, so that 30 degrees count as 30 degrees."""

LARGEST_OFFSET_S = 14 * 3600.0
"""Largest offset from UTC; times of which only one has a known zone may differ by so much."""

Direction = tuple[float, float, float]
"""Unit vector from the isocentre to the detector in patient axes (LPS)."""
Rule = Literal["explicit", "csv", "upload", "order"]
_STRENGTH: tuple[Rule, ...] = ("explicit", "csv", "upload", "order")


@dataclass(frozen=True, slots=True)
class Run:
    """One run, with everything that the rules read.

    Parameters
    ----------
    uid : str
        SOP Instance UID.
    arrival : int
        Rises in the order of arrival.
    direction : Direction or None
        None while gantry angles are missing.
    acquired : datetime or None
        Earliest start of the run, UTC.
    within_s : float
        Seconds after ``acquired`` within which it began.
    zone_known : bool
        Whether the offset of ``acquired`` from UTC is known.
    table_origin : TableOrigin or None
        The attributes that state the table's position; None where it is unknown.
    series_number : int or None
    file_name : str or None
        Name of the uploaded file.
    site, site_by : str or None
        Site that the upload ("upload") or a PATCH ("explicit") gave.
    gantry_turned, table_moved : bool
        Whether the gantry or the table moved during the run.
    """

    uid: str
    arrival: int
    direction: Direction | None
    acquired: datetime | None
    table_origin: TableOrigin | None = None
    series_number: int | None = None
    file_name: str | None = None
    site: str | None = None
    site_by: str | None = None
    gantry_turned: bool = False
    table_moved: bool = False
    within_s: float = 0.0
    zone_known: bool = True


@dataclass(frozen=True, slots=True)
class Site:
    """One site, with everything that the rules read.

    Parameters
    ----------
    name : str
    csv_row : int or None
        Row of the last activation-time table that named the site.
    explicit_a, explicit_b : str or None
        SOP Instance UIDs set by PUT.
    csv_a, csv_b : str or None
        Run that the table names: UID, series number or file name.
    ordered_a, ordered_b : str or None
        SOP Instance UIDs of a pairing by row order, stored when a person confirmed it for another site.
    """

    name: str
    csv_row: int | None = None
    explicit_a: str | None = None
    explicit_b: str | None = None
    csv_a: str | None = None
    csv_b: str | None = None
    ordered_a: str | None = None
    ordered_b: str | None = None


Pair = tuple[Run, Run]


@dataclass(frozen=True, slots=True)
class SiteRuns:
    """The runs of one site; ``bound_by`` is the strongest rule that gave a run, None without runs."""

    a: Run | None = None
    b: Run | None = None
    bound_by: Rule | None = None


@dataclass(frozen=True, slots=True)
class Pairing:
    """The runs of all sites by the site's name, and the pairs without a name in the order of acquisition.

    ``doubtful`` : UIDs of the runs that time paired although the headers allow another order.
    """

    sites: Mapping[str, SiteRuns]
    unnamed: tuple[Pair, ...]
    doubtful: frozenset[str] = frozenset()


def pair_runs(sites: Sequence[Site], runs: Sequence[Run]) -> Pairing:
    """Apply the rules to a study's sites (in order of first mention) and runs (in order of arrival)."""
    draft = _Draft(sites, runs)
    draft.take_explicit_views()
    draft.take_members("explicit")
    draft.take_table_views()
    draft.take_members("upload")
    timed = [run for run in draft.free.values() if run.acquired is not None]
    draft.take_ordered_pairs()
    unnamed = pairs_by_time(list(draft.free.values()))
    rows = draft.rows_without_runs()
    if rows and len(rows) == len(unnamed) and _nobody_named(sites, runs):
        for site, pair in zip(rows, unnamed, strict=True):
            draft.slots[site.name] = _Slots(*pair, "order")
        unnamed = []
    sites_runs = {name: slots.result() for name, slots in draft.slots.items()}
    ordered = [(each.a, each.b) for each in sites_runs.values() if each.bound_by == "order" and each.a and each.b]
    return Pairing(sites_runs, tuple(unnamed), _doubtful([*ordered, *unnamed], timed))


def _doubtful(pairs: Sequence[Pair], timed: Sequence[Run]) -> frozenset[str]:
    """Return the UIDs of the pairs that another run may change.

    The times of that run and of a run of the pair do not say which of them came first. The order within a pair does not
    matter: the two planes of a biplane system begin together.
    """
    return frozenset(
        uid
        for first, second in pairs
        for uid in (first.uid, second.uid)
        if any(
            not order_known(run, third)
            for run in (first, second)
            for third in timed
            if third.uid not in (first.uid, second.uid)
        )
    )


def order_known(first: Run, second: Run) -> bool:
    """Return whether the headers say which of two runs with a time began first."""
    earlier, later = sorted((first, second), key=_moment)
    apart_s = (_acquired(later) - _acquired(earlier)).total_seconds()
    zones_s = 0.0 if first.zone_known == second.zone_known else LARGEST_OFFSET_S
    return apart_s > 0 and apart_s >= earlier.within_s + zones_s


def _nobody_named(sites: Sequence[Site], runs: Sequence[Run]) -> bool:
    """Return whether the sites are only rows of a table without views."""
    bare = [
        site.csv_row is not None and not any((site.explicit_a, site.explicit_b, site.csv_a, site.csv_b))
        for site in sites
    ]
    return all(bare) and all(run.site is None for run in runs)


@dataclass(eq=False)
class _Slots:
    """The two runs of one site while the rules apply; ``named``: a person or table said which run is a or b."""

    a: Run | None = None
    b: Run | None = None
    by: Rule | None = None
    named: bool = False

    @property
    def runs(self) -> list[Run]:
        return [run for run in (self.a, self.b) if run is not None]

    def put(self, view: str, run: Run, by: Rule) -> None:
        setattr(self, view, run)
        if self.by is None or _STRENGTH.index(by) < _STRENGTH.index(self.by):
            self.by = by

    def result(self) -> SiteRuns:
        """Return the runs; view a is the one nearer to lateral unless somebody named the views."""
        if self.a is None or self.b is None or self.named:
            return SiteRuns(self.a, self.b, self.by)
        return SiteRuns(*lateral_first(self.a, self.b), self.by)


class _Draft:
    """The state between two rules: the runs of each site, and the runs that no site has yet."""

    def __init__(self, sites: Sequence[Site], runs: Sequence[Run]) -> None:
        self._sites = sites
        self._runs = runs
        self.slots = {site.name: _Slots() for site in sites}
        self.free = {run.uid: run for run in runs}

    def take_explicit_views(self) -> None:
        by_uid = {run.uid: run for run in self._runs}
        for site in self._sites:
            for view, uid in (("a", site.explicit_a), ("b", site.explicit_b)):
                if uid is not None:
                    self._take_view(site, view, by_uid.get(uid), "explicit")

    def take_table_views(self) -> None:
        names = RunNames(self._runs)
        for site in self._sites:
            for view, text in (("a", site.csv_a), ("b", site.csv_b)):
                if text is not None:
                    self._take_view(site, view, names.run(text), "csv")

    def _take_view(self, site: Site, view: str, run: Run | None, by: Rule) -> None:
        slots = self.slots[site.name]
        slots.named = True
        if run is not None and run.uid in self.free and getattr(slots, view) is None:
            slots.put(view, self.free.pop(run.uid), by)

    def take_members(self, by: Rule) -> None:
        """Fill the free views of each site with its own runs.

        The runs come in order of arrival; a third run stays free.
        """
        members_of: dict[str | None, list[Run]] = defaultdict(list)
        for run in self._runs:
            if run.uid in self.free and run.site_by == by:
                members_of[run.site].append(run)
        for name, slots in self.slots.items():
            members = members_of[name]
            while members and len(slots.runs) < 2:
                present = slots.runs
                chosen = next((run for run in members if present and _apart(present[0], run)), members[0])
                members.remove(chosen)
                wanted, other = ("a", "b") if _lateral_share(chosen) > math.sqrt(0.5) else ("b", "a")
                view = wanted if getattr(slots, wanted) is None else other
                slots.put(view, self.free.pop(chosen.uid), by)

    def take_ordered_pairs(self) -> None:
        """Take the pairs by row order that a person confirmed.

        Both runs and the site must still be free.
        """
        for site in self._sites:
            first, second = self.free.get(site.ordered_a or ""), self.free.get(site.ordered_b or "")
            if first is not None and second is not None and not self.slots[site.name].runs:
                self.slots[site.name] = _Slots(self.free.pop(first.uid), self.free.pop(second.uid), "order")

    def rows_without_runs(self) -> list[Site]:
        """Return the table's sites without runs, in row order.

        They name no run either.
        """
        rows = [
            site
            for site in self._sites
            if site.csv_row is not None
            and self.slots[site.name].by is None
            and site.csv_a is None
            and site.csv_b is None
        ]
        return sorted(rows, key=lambda site: site.csv_row or 0)


class RunNames:
    """The texts that may name each run of a study in a table.

    They are the SOP Instance UID, the series number, the file name and its last part; the first that fits any run counts.
    """

    def __init__(self, runs: Sequence[Run]) -> None:
        uids, numbers, names, base_names = (defaultdict[str, list[Run]](list) for _ in range(4))
        for run in runs:
            uids[run.uid].append(run)
            if run.series_number is not None:
                numbers[str(run.series_number)].append(run)
            if run.file_name is not None:
                name = normal_name(run.file_name)
                names[name].append(run)
                base_names[_base_name(name)].append(run)
        self._tests = ((uids, str), (numbers, str), (names, str), (base_names, _base_name))

    def run(self, text: str) -> Run | None:
        """Return the run that a text names; None unless it fits just one run."""
        text = normal_name(text.strip())
        for found, form in self._tests:
            runs = found.get(form(text))
            if runs:
                return runs[0] if len(runs) == 1 else None
        return None


def _base_name(path: str) -> str:
    return path.replace("\\", "/").rsplit("/", 1)[-1]


def pairs_by_time(runs: Sequence[Run]) -> list[Pair]:
    """Pair runs that follow each other in acquisition time.

    Their views are 30 degrees or more apart. The table may move between them. A run that repeats a direction stays alone.
    Of all ways to pair neighbours, the one with most pairs wins; then the one with the least time between the runs of a
    pair; then the earliest.
    """
    timed = sorted((run for run in runs if run.acquired is not None), key=_moment)
    Best = tuple[int, float, list[Pair]]
    best: list[Best] = [(0, 0.0, [])] * (len(timed) + 2)
    for index in range(len(timed) - 2, -1, -1):
        skipped = best[index + 1]
        first, second = timed[index], timed[index + 1]
        best[index] = skipped
        if _apart(first, second):
            gap = (_acquired(second) - _acquired(first)).total_seconds()
            count, total, pairs = best[index + 2]
            joined: Best = (count + 1, total + gap, [(first, second), *pairs])
            if (joined[0], -joined[1]) >= (skipped[0], -skipped[1]):
                best[index] = joined
    return best[0][2]


def _acquired(run: Run) -> datetime:
    assert run.acquired is not None
    return run.acquired


def _moment(run: Run) -> tuple[float, int]:
    return (run.acquired.timestamp() if run.acquired is not None else math.inf, run.arrival)


@functools.lru_cache(maxsize=1024)
def central_ray(primary_deg: float, secondary_deg: float) -> Direction:
    """Return the direction from the isocentre to the detector of a gantry position."""
    x, y, z = view_axes(primary_deg, secondary_deg)[2].tolist()
    return x, y, z


def view_angle_deg(first: Run, second: Run) -> float | None:
    """Return the angle between two runs' central rays, 0..90 degrees.

    None while angles are missing.
    """
    if first.direction is None or second.direction is None:
        return None
    return direction_angle_deg(first.direction, second.direction)


def _apart(first: Run, second: Run) -> bool:
    angle = view_angle_deg(first, second)
    return angle is not None and angle >= PAIRING_ANGLE_DEG - ROUNDING_DEG


def tables_comparable(first: Run, second: Run) -> bool:
    """Return whether the table's displacement can be computed, or no run states it.

    Two positions can be compared when they count from the same origin. Otherwise the displacement between the runs is unknown
    although a header states a position.
    """
    return first.table_origin == second.table_origin


def lateral_first(first: Run, second: Run) -> Pair:
    """Return a pair with the run nearer to lateral first.

    Where angles are missing, the given order stays.
    """
    shares = _lateral_share(first), _lateral_share(second)
    return (second, first) if min(shares) >= 0 and shares[1] > shares[0] + 1e-9 else (first, second)


def _lateral_share(run: Run) -> float:
    """Return 1 for a lateral view, 0 for a frontal one.

    -1 where angles are missing.
    """
    return -1.0 if run.direction is None else abs(run.direction[0])
