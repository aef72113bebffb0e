"""The pairing rules as pure functions, without a database."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluoromap_service.dicom.facts import TableOrigin
from fluoromap_service.study.pairing import (
    Pairing,
    Run,
    RunNames,
    Site,
    central_ray,
    order_known,
    pair_runs,
    pairs_by_time,
    tables_comparable,
    view_angle_deg,
)

START = datetime(2026, 3, 1, 9, 30, tzinfo=UTC)
LAT, PA = -90.0, 0.0


def run(number: int, primary_deg: float | None, seconds: float | None = -1.0, **facts: Any) -> Run:
    """Return run ``number``.

    It begins 20 s after the run before unless ``seconds`` says otherwise. None: unknown.
    """
    moment = None if seconds is None else START + timedelta(seconds=20.0 * number if seconds < 0 else seconds)
    direction = None if primary_deg is None else central_ray(primary_deg, 0.0)
    return Run(f"1.2.{number}", number, direction, moment, **facts)


def uids(pairing: Pairing, site: str) -> tuple[str | None, str | None, str | None]:
    runs = pairing.sites[site]
    return (runs.a.uid if runs.a else None, runs.b.uid if runs.b else None, runs.bound_by)


def unnamed(pairing: Pairing) -> list[tuple[str, str]]:
    return [(first.uid, second.uid) for first, second in pairing.unnamed]


def test_without_sites_neighbours_in_time_become_unnamed_pairs() -> None:
    runs = [run(4, PA), run(2, PA), run(1, LAT), run(3, LAT)]
    assert unnamed(pair_runs([], runs)) == [("1.2.1", "1.2.2"), ("1.2.3", "1.2.4")]


@pytest.mark.parametrize(("angle", "pairs"), [(29.9, 0), (30.0, 1), (90.0, 1), (150.1, 0), (178.0, 0)])
def test_views_less_than_30_degrees_apart_are_not_paired(angle: float, pairs: int) -> None:
    assert len(pairs_by_time([run(1, 0.0), run(2, angle)])) == pairs


def test_most_pairs_win_then_the_shortest_time_within_pairs_then_the_earliest() -> None:
    repeated = [run(1, LAT, 0), run(2, PA, 20), run(3, PA, 25), run(4, LAT, 100)]
    assert [(a.uid, b.uid) for a, b in pairs_by_time(repeated)] == [("1.2.1", "1.2.2"), ("1.2.3", "1.2.4")]
    odd = [run(1, LAT, 0), run(2, PA, 60), run(3, LAT, 70)]
    assert [(a.uid, b.uid) for a, b in pairs_by_time(odd)] == [("1.2.2", "1.2.3")]
    equal = [run(1, LAT, 0), run(2, PA, 20), run(3, LAT, 40)]
    assert [(a.uid, b.uid) for a, b in pairs_by_time(equal)] == [("1.2.1", "1.2.2")]


@pytest.mark.parametrize(
    ("seconds", "within_s", "doubtful"),
    [
        ((0, 60, 600, 660), 1.0, ()),
        ((0, 60, 600, 660), 60.0, ()),
        ((0, 60, 600, 660), 61.0, ()),  # within each pair the order does not matter
        ((0, 60, 120, 180), 61.0, (1, 2, 3, 4)),
        ((0, 60, 600, 660), 3600.0, (1, 2, 3, 4)),
        ((0, 0, 60, 60), 1.0, ()),  # the planes of a biplane system begin together
        ((0, 0, 0, 0), 0.0, (1, 2, 3, 4)),
        ((0, 0, 0, 60), 1.0, (1, 2, 3, 4)),
        ((0, 60), 86400.0, ()),
    ],
)
def test_a_pair_is_doubtful_where_another_run_may_belong_between(
    seconds: tuple[float, ...], within_s: float, doubtful: tuple[int, ...]
) -> None:
    runs = [
        run(number, LAT if number % 2 else PA, float(second), within_s=within_s)
        for number, second in enumerate(seconds, start=1)
    ]
    found = pair_runs([], runs)
    assert unnamed(found) == [(f"1.2.{number}", f"1.2.{number + 1}") for number in range(1, len(runs), 2)]
    assert found.doubtful == {f"1.2.{number}" for number in doubtful}


def test_the_order_is_unknown_between_a_known_and_an_unknown_zone() -> None:
    first, second = run(1, LAT, 0.0), run(2, PA, 3600.0, zone_known=False)
    assert not order_known(first, second)
    assert order_known(first, replace(second, zone_known=True))
    assert order_known(first, replace(second, acquired=START + timedelta(hours=15)))


def test_named_runs_are_never_doubtful() -> None:
    runs = [run(number, LAT if number % 2 else PA, 0.0) for number in range(1, 5)]
    named = [Site("first", explicit_a="1.2.1", explicit_b="1.2.2"), Site("second", csv_row=1)]
    found = pair_runs(named, runs)
    assert uids(found, "first") == ("1.2.1", "1.2.2", "explicit")
    # Only one pair is left, so that nothing can be exchanged.
    assert found.doubtful == frozenset()
    by_order = pair_runs([Site("first", csv_row=1), Site("second", csv_row=2)], runs)
    assert uids(by_order, "second") == ("1.2.3", "1.2.4", "order")
    assert by_order.doubtful == {run.uid for run in runs}


def test_runs_without_time_or_angles_stay_alone() -> None:
    assert pairs_by_time([run(1, LAT, None), run(2, PA)]) == []
    assert pairs_by_time([run(1, None), run(2, PA)]) == []
    assert view_angle_deg(run(1, None), run(2, PA)) is None


@pytest.mark.parametrize(
    ("first", "second", "comparable"),
    [
        (TableOrigin.GE, TableOrigin.GE, True),
        (None, None, True),
        (TableOrigin.GE, None, False),
        (None, TableOrigin.TABLE_TOP, False),
        (TableOrigin.GE, TableOrigin.TABLE_TOP, False),
    ],
)
def test_only_positions_of_the_table_with_the_same_origin_can_be_compared(
    first: TableOrigin | None, second: TableOrigin | None, comparable: bool
) -> None:
    pair = run(1, LAT, table_origin=first), run(2, PA, table_origin=second)
    assert tables_comparable(*pair) is comparable
    assert len(pairs_by_time(pair)) == 1


def test_view_a_is_nearer_to_lateral_unless_somebody_named_the_views() -> None:
    frontal, lateral = run(1, 10.0, site="x", site_by="upload"), run(2, 70.0, site="x", site_by="upload")
    assert uids(pair_runs([Site("x")], [frontal, lateral]), "x") == ("1.2.2", "1.2.1", "upload")
    named = Site("x", explicit_a="1.2.1", explicit_b="1.2.2")
    assert uids(pair_runs([named], [frontal, lateral]), "x") == ("1.2.1", "1.2.2", "explicit")


RUN = run(1, LAT, site="upload", site_by="upload")
OTHER = run(2, PA)


@pytest.mark.parametrize(
    ("sites", "site", "rule"),
    [
        ([Site("put", explicit_a="1.2.1"), Site("table", csv_row=2, csv_a="1.2.1"), Site("upload")], "put", "explicit"),
        ([Site("table", csv_row=2, csv_a="1.2.1"), Site("upload")], "table", "csv"),
        (
            [
                Site(
                    "row",
                    csv_row=2,
                ),
                Site("upload"),
            ],
            "upload",
            "upload",
        ),
    ],
)
def test_the_stronger_rule_takes_the_run(sites: list[Site], site: str, rule: str) -> None:
    pairing = pair_runs(sites, [RUN, OTHER])
    assert uids(pairing, site)[0::2] == ("1.2.1", rule)
    others = [each.name for each in sites if each.name != site]
    assert all(uids(pairing, name) == (None, None, None) for name in others)


def test_patch_comes_before_the_table() -> None:
    patched = run(1, LAT, site="patched", site_by="explicit")
    pairing = pair_runs([Site("table", csv_row=2, csv_a="1.2.1"), Site("patched")], [patched])
    assert uids(pairing, "patched") == ("1.2.1", None, "explicit")


def test_a_site_takes_two_runs_that_are_apart_and_leaves_the_third() -> None:
    members = [run(number, angle, site="x", site_by="upload") for number, angle in ((1, LAT), (2, -85.0), (3, PA))]
    assert uids(pair_runs([Site("x")], members), "x") == ("1.2.1", "1.2.3", "upload")


def test_rows_take_the_pairs_in_order_when_the_counts_agree() -> None:
    runs = [run(3, LAT), run(4, PA), run(1, LAT), run(2, PA)]
    rows = [Site("zeta", csv_row=2), Site("alpha", csv_row=3)]
    pairing = pair_runs(rows, runs)
    assert uids(pairing, "zeta") == ("1.2.1", "1.2.2", "order")
    assert uids(pairing, "alpha") == ("1.2.3", "1.2.4", "order")
    assert unnamed(pairing) == []
    one_more = pair_runs([*rows, Site("third", csv_row=4)], runs)
    assert uids(one_more, "zeta") == (None, None, None)
    assert len(one_more.unnamed) == 2


def test_rows_that_name_runs_take_no_pair_by_order() -> None:
    row = Site("zeta", csv_row=2, csv_a="missing.dcm")
    assert uids(pair_runs([row], [run(1, LAT), run(2, PA)]), "zeta") == (None, None, None)


def test_an_order_that_a_person_confirmed_elsewhere_stays() -> None:
    confirmed = Site("alpha", csv_row=2, explicit_a="1.2.1", explicit_b="1.2.2")
    ordered = Site("beta", csv_row=3, ordered_a="1.2.3", ordered_b="1.2.4")
    runs = [run(1, LAT), run(2, PA), run(3, LAT), run(4, PA)]
    pairing = pair_runs([confirmed, ordered], runs)
    assert uids(pairing, "alpha") == ("1.2.1", "1.2.2", "explicit")
    assert uids(pairing, "beta") == ("1.2.3", "1.2.4", "order")
    assert uids(pair_runs([ordered], runs[3:]), "beta") == (None, None, None)


@pytest.mark.parametrize(
    "sites",
    [
        [Site("S01", csv_row=2), Site("S02", csv_row=3), Site("apex")],
        [Site("S01", csv_row=2), Site("S02", csv_row=3, explicit_a="1.2.9")],
        [Site("S01", csv_row=2), Site("S02", csv_row=3), Site("x", csv_row=4, csv_a="nowhere.dcm")],
    ],
)
def test_rows_take_no_pair_by_order_when_anything_has_a_name(sites: list[Site]) -> None:
    pairing = pair_runs(sites, [run(1, LAT), run(2, PA), run(3, LAT), run(4, PA)])
    assert len(pairing.unnamed) == 2
    assert all(runs.bound_by != "order" for runs in pairing.sites.values())


def test_a_run_that_was_named_at_the_upload_ends_the_order() -> None:
    runs = [run(1, LAT), run(2, PA), run(3, LAT, site="apex", site_by="upload"), run(4, PA)]
    pairing = pair_runs([Site("S01", csv_row=2), Site("apex")], runs)
    assert uids(pairing, "S01") == (None, None, None)


@given(st.data())
def test_a_site_never_gets_the_runs_of_another_without_a_warning(data: st.DataObject) -> None:
    """Pairs in any order of arrival, rows in any order, any names, some runs named: right, unmatched, or warned."""
    count = data.draw(st.integers(1, 5))
    named = data.draw(st.sets(st.integers(0, count - 1)))
    rows = data.draw(st.permutations(range(count)))[: data.draw(st.integers(0, count))]
    names = data.draw(st.permutations([f"S{k + 1:02d}" for k in range(count)]))
    numbers = data.draw(st.permutations(range(2 * count)))
    runs = []
    for arrival, number in enumerate(numbers):
        given_site = names[number // 2] if number // 2 in named else None
        angle = PA if number % 2 else LAT
        made = run(number, angle, site=given_site, site_by=None if given_site is None else "upload")
        runs.append(replace(made, arrival=arrival))
    sites = [Site(names[k], csv_row=row + 2) for row, k in enumerate(rows)]
    sites += [Site(names[k]) for k in sorted(named) if k not in rows]
    pairing = pair_runs(sites, runs)
    for k, name in enumerate(names):
        found = pairing.sites.get(name)
        if found is None or found.a is None or found.b is None:
            continue
        right = {found.a.uid, found.b.uid} == {f"1.2.{2 * k}", f"1.2.{2 * k + 1}"}
        assert right or found.bound_by == "order"
        if found.bound_by == "order":
            assert not named
            assert len(rows) == count


def test_a_table_names_runs_by_uid_series_number_or_file_name() -> None:
    runs = [
        run(1, LAT, series_number=7, file_name="C:\\export\\left.dcm"),
        run(2, PA, series_number=8, file_name="right.dcm"),
        run(3, PA, series_number=8, file_name="other/right.dcm"),
    ]
    names = RunNames(runs)
    for text in ("1.2.1", " 7 ", "C:\\export\\left.dcm", "left.dcm", "folder/left.dcm"):
        assert names.run(text) == runs[0], text
    # The whole name fits one run, although the base name fits two.
    assert names.run("right.dcm") == runs[1]
    for text in ("8", "elsewhere/right.dcm", "nowhere.dcm", ""):
        assert names.run(text) is None, text
