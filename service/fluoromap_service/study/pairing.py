"""Which two runs belong to which mapping site.

What the user said comes first: runs set by PUT or PATCH, then those the activation-time table names, then the site given at
upload, then the table's row order. Runs that nobody spoke for are paired when they follow each other in acquisition time and
look from directions 30 degrees or more apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime

from fluoromap_service.store.models import Site
from fluoromap_service.study.instances import StudyRun, central_ray, ray_angle_deg

PAIRING_ANGLE_DEG = 30.0
"""Runs nearer to each other in direction are not paired by time."""
PARALLEL_ANGLE_DEG = 20.0
"""Below this even an explicit pair is refused."""
ROUNDING_DEG = 1e-6
"""Angles are compared with this much tolerance, so that 30 degrees are 30 degrees."""
TABLE_STILL_MM = 1.0
"""A table that moved farther between two runs moved the patient off the isocentre."""

_STRENGTH = ("explicit", "csv", "upload", "order", "time")


@dataclass(eq=False)
class Slots:
    """The two runs of one site while the rules are applied; ``named`` once someone said which of them is a or b."""

    a: StudyRun | None = None
    b: StudyRun | None = None
    by: str | None = None
    named: bool = False

    @property
    def runs(self) -> list[StudyRun]:
        return [run for run in (self.a, self.b) if run is not None]

    def rule(self, by: str) -> None:
        if self.by is None or _STRENGTH.index(by) < _STRENGTH.index(self.by):
            self.by = by


@dataclass(eq=False)
class Binding:
    """All sites' runs. ``slots``: site name -> its runs; ``fresh``: pairs by time that have no name yet."""

    slots: dict[str, Slots]
    fresh: list[tuple[StudyRun, StudyRun]]


def bind(rows: Sequence[Site], runs: Sequence[StudyRun]) -> Binding:
    """Apply the rules to a study's sites (in order of first mention) and runs (in order of arrival)."""
    slots = {row.name: Slots() for row in rows}
    by_uid = {run.uid: run for run in runs}
    free = dict(by_uid)

    def take(site: str, view: str, run: StudyRun | None, by: str) -> None:
        slot = slots[site]
        if run is None or run.uid not in free or getattr(slot, view) is not None:
            return
        setattr(slot, view, free.pop(run.uid))
        slot.rule(by)

    for row in rows:
        for view, uid in (("a", row.explicit_a), ("b", row.explicit_b)):
            if uid is not None:
                take(row.name, view, by_uid.get(uid), "explicit")
                slots[row.name].named = True
    _take_members(slots, free, runs, "explicit")
    for row in rows:
        for view, text in (("a", row.csv_a), ("b", row.csv_b)):
            if text is not None:
                take(row.name, view, told_run(text, runs), "csv")
                slots[row.name].named = True
    _take_members(slots, free, runs, "upload")

    kept: list[tuple[Site, StudyRun, StudyRun]] = []
    for row in rows:
        first, second = free.get(row.paired_a or ""), free.get(row.paired_b or "")
        if first is not None and second is not None and not slots[row.name].runs:
            kept.append((row, free.pop(first.uid), free.pop(second.uid)))
    fresh = pairs_by_time(list(free.values()))
    unbound = [row for row in rows if row.csv_row is not None and slots[row.name].by is None]
    unbound = [row for row in unbound if not any(row is owner for owner, _, _ in kept)]
    unbound = sorted(
        (row for row in unbound if row.csv_a is None and row.csv_b is None), key=lambda row: row.csv_row or 0
    )
    anonymous = [(row, a, b) for row, a, b in kept if row.csv_row is None and row.lat_ms is None]
    pairs = sorted([*((a, b) for _, a, b in anonymous), *fresh], key=lambda pair: _moment(pair[0]))
    if unbound and len(unbound) == len(pairs):
        for row, (first, second) in zip(unbound, pairs, strict=True):
            slots[row.name] = Slots(first, second, "order")
        kept = [entry for entry in kept if entry not in anonymous]
        fresh = []
    for row, first, second in kept:
        slots[row.name] = Slots(first, second, "time")
    for slot in slots.values():
        _lateral_first(slot)
    return Binding(slots, fresh)


def _take_members(slots: dict[str, Slots], free: dict[str, StudyRun], runs: Sequence[StudyRun], by: str) -> None:
    """Fill what is free of each site with the runs that were put there, as they arrived; a third one stays unbound."""
    for site, slot in slots.items():
        members = [run for run in runs if run.uid in free and run.link.site == site and run.link.site_by == by]
        while members and len(slot.runs) < 2:
            present = slot.runs
            chosen = next((run for run in members if present and _apart(present[0], run)), members[0])
            members.remove(chosen)
            wanted = "a" if _is_lateral(chosen) else "b"
            other = {"a": "b", "b": "a"}[wanted]
            setattr(slot, wanted if getattr(slot, wanted) is None else other, free.pop(chosen.uid))
            slot.rule(by)


def told_run(text: str, runs: Sequence[StudyRun]) -> StudyRun | None:
    """The run that a table names by SOP Instance UID, series number or uploaded file name; None unless it is just one."""
    text = text.strip()
    tests: tuple[Callable[[StudyRun], bool], ...] = (
        lambda run: run.uid == text,
        lambda run: run.facts.series_number is not None and str(run.facts.series_number) == text,
        lambda run: run.link.file_name == text,
        lambda run: run.link.file_name is not None and _base_name(run.link.file_name) == _base_name(text),
    )
    for test in tests:
        found = [run for run in runs if test(run)]
        if found:
            return found[0] if len(found) == 1 else None
    return None


def _base_name(path: str) -> str:
    return path.replace("\\", "/").rsplit("/", 1)[-1]


def pairs_by_time(runs: Sequence[StudyRun]) -> list[tuple[StudyRun, StudyRun]]:
    """Pair runs next in acquisition time, 30 degrees or more apart and with the table where it was.

    A run repeated in the same direction leaves an odd one out. Of all ways to pair neighbours the one with most pairs is
    taken, then the one with the least time between the runs of a pair, then the earliest.
    """
    timed = sorted((run for run in runs if run.facts.acquired is not None), key=_moment)
    Best = tuple[int, float, list[tuple[StudyRun, StudyRun]]]
    best: list[Best] = [(0, 0.0, [])] * (len(timed) + 2)
    for index in range(len(timed) - 2, -1, -1):
        skipped = best[index + 1]
        first, second = timed[index], timed[index + 1]
        best[index] = skipped
        if _apart(first, second) and not table_moved(first, second):
            gap = (_acquired(second) - _acquired(first)).total_seconds()
            count, total, pairs = best[index + 2]
            joined: Best = (count + 1, total + gap, [(first, second), *pairs])
            if (joined[0], -joined[1]) >= (skipped[0], -skipped[1]):
                best[index] = joined
    return best[0][2]


def _acquired(run: StudyRun) -> datetime:
    assert run.facts.acquired is not None
    return run.facts.acquired


def _moment(run: StudyRun) -> tuple[float, int]:
    acquired = run.facts.acquired
    return (acquired.timestamp() if acquired is not None else math.inf, run.link.id)


def _apart(first: StudyRun, second: StudyRun) -> bool:
    angle = ray_angle_deg(first, second)
    return angle is not None and angle >= PAIRING_ANGLE_DEG - ROUNDING_DEG


def table_moved(first: StudyRun, second: StudyRun) -> bool:
    """Whether both headers tell the table's place and it moved between the runs."""
    if first.facts.table_mm is None or second.facts.table_mm is None:
        return False
    return math.dist(first.facts.table_mm, second.facts.table_mm) > TABLE_STILL_MM


def _lateral_share(run: StudyRun) -> float:
    """1 for a lateral view, 0 for a frontal one, -1 where the angles are missing."""
    ray = central_ray(run)
    return -1.0 if ray is None else abs(ray[0])


def _is_lateral(run: StudyRun) -> bool:
    return _lateral_share(run) > math.sqrt(0.5)


def _lateral_first(slot: Slots) -> None:
    if slot.a is None or slot.b is None or slot.named:
        return
    share_a, share_b = _lateral_share(slot.a), _lateral_share(slot.b)
    if min(share_a, share_b) >= 0 and share_b > share_a + 1e-9:
        slot.a, slot.b = slot.b, slot.a
